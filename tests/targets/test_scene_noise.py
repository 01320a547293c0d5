"""The noise of a photograph from residuals: white, growing with light, correlated, with outliers. The spread of normals from tilts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from dishmap.targets.scene_noise import LEAST_NORMAL_SIGMA_RAD, NoiseModel, inflation_of, noise_model, normal_spread

Array = NDArray[np.float64]

# 40 rings of 400 pixels: a variance by the median is known to 1.2 / sqrt(16000 / 12 levels) * 2 = 6 % per level.
VARIANCE_PART = 0.15
# A correlation from 4000 blocks is known to 0.011 in each of two pairs; both directions multiply.
WHITE_INFLATION = 1.06
RINGS, BLOCKS = 40, 100
INK, GROUND = 20.0, 180.0


def levels(rng: np.random.Generator) -> Array:
    """Grey levels of rings: half ink, half ground, unevenly lit; a tenth between."""
    values = np.where(rng.random((RINGS, 4 * BLOCKS)) < 0.5, INK, GROUND) * rng.uniform(0.97, 1.03, (RINGS, 4 * BLOCKS))
    return np.where(rng.random(values.shape) < 0.1, rng.uniform(INK, GROUND, values.shape), values)


def fitted(model: Array, residual: Array, blocks: bool = True, used: NDArray[np.bool_] | None = None) -> NoiseModel:
    used = np.ones(model.shape, bool) if used is None else used
    pairs = [(residual, used)] if blocks else []
    inflation = inflation_of([r for r, _ in pairs], [u for _, u in pairs])
    return replace(noise_model([model + residual], [residual], [used]), inflation=inflation)


def in_blocks(image: Array, rng: np.random.Generator) -> Array:
    """Blocks of 2x2 neighbours (RINGS, 4 BLOCKS) at random places of a noise image."""
    row, column = (rng.integers(0, n - 1, (RINGS, BLOCKS)) for n in image.shape)
    return np.stack([image[row, column], image[row, column + 1], image[row + 1, column], image[row + 1, column + 1]], axis=-1).reshape(
        RINGS, -1
    )


def test_white_noise_of_one_size() -> None:
    rng = np.random.default_rng(1)
    noise = fitted(levels(rng), 2 * rng.standard_normal((RINGS, 4 * BLOCKS)))
    assert noise.slope == 0
    assert noise.base == pytest.approx(4, rel=VARIANCE_PART)
    assert 1 <= noise.inflation < WHITE_INFLATION


def test_shot_noise_grows_with_light() -> None:
    rng = np.random.default_rng(2)
    model = levels(rng)
    noise = fitted(model, np.sqrt(1 + 0.05 * model) * rng.standard_normal(model.shape))
    assert noise.slope == pytest.approx(0.05, rel=VARIANCE_PART)
    for grey in (INK, GROUND):
        assert noise.variance(np.array(grey)) == pytest.approx(1 + 0.05 * grey, rel=VARIANCE_PART)


def test_no_variance_is_zero_or_negative() -> None:
    noise = NoiseModel(1.0, -0.1, 1.0)
    assert (noise.variance(np.array([-5.0, 0.0, 50.0])) > 0).all()
    assert fitted(np.full((2, 400), GROUND), np.zeros((2, 400))).base > 0


def test_outliers_do_not_count() -> None:
    rng = np.random.default_rng(3)
    residual = rng.standard_normal((RINGS, 4 * BLOCKS))
    residual[rng.random(residual.shape) < 0.03] = 60
    assert fitted(levels(rng), residual).base == pytest.approx(1, rel=VARIANCE_PART)


def test_pixels_that_are_not_used_do_not_count() -> None:
    rng = np.random.default_rng(4)
    residual = rng.standard_normal((RINGS, 4 * BLOCKS))
    used = np.ones(residual.shape, bool)
    used[:, 200:], residual[:, 200:] = False, 30
    noise = fitted(levels(rng), residual, used=used)
    assert noise.base == pytest.approx(1, rel=2 * VARIANCE_PART)
    assert noise.inflation < 1.1


@pytest.mark.parametrize("sigma_px", [0.4, 0.5, 0.6])
def test_correlated_noise_is_inflated_by_at_least_what_averages_show(sigma_px: float) -> None:
    """The variance of an average over many pixels, over that of as many independent ones."""
    rng = np.random.default_rng(5)
    image = gaussian_filter(rng.standard_normal((400, 400)), sigma_px, mode="wrap")
    image *= 2 / image.std()
    noise = fitted(levels(rng), in_blocks(image, rng))
    means = image.reshape(20, 20, 20, 20).mean(axis=(1, 3))
    true = means.var() * 400 / image.var()
    assert noise.base == pytest.approx(4, rel=VARIANCE_PART)
    # the model is cautious: its tails fall geometrically, those of a Gaussian faster
    assert 0.85 * true < noise.inflation < 3 * true
    assert noise.inflation > 1.2


def test_negative_correlation_deflates_nothing() -> None:
    rng = np.random.default_rng(6)
    image = rng.standard_normal((300, 301))
    noise = fitted(levels(rng), in_blocks(image[:, 1:] - image[:, :-1], rng))
    assert 1 <= noise.inflation < 1.1


def test_pixels_that_are_no_neighbours_say_nothing_of_correlation() -> None:
    rng = np.random.default_rng(7)
    residual = np.repeat(rng.standard_normal((RINGS, BLOCKS)), 4, axis=1)
    assert fitted(levels(rng), residual, blocks=False).inflation == 1
    assert fitted(levels(rng), residual, blocks=True).inflation > 3


def test_a_handful_of_pixels_is_enough_for_a_number() -> None:
    noise = fitted(np.full((1, 20), GROUND), np.random.default_rng(8).standard_normal((1, 20)))
    assert noise.slope == 0
    assert 0.1 < noise.base < 5
    assert noise.inflation == 1


WIDEST_RAD = np.radians(12.0)


def shrunk(spread_deg: float, data_deg: float, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Errors (count, 2) of tilts held by the spread that is learnt from all of them, over their claimed sigmas; and the sigmas, rad."""
    true = np.radians(spread_deg) * rng.standard_normal((count, 2))
    seen = true + np.radians(data_deg) * rng.standard_normal((count, 2))
    variance = np.radians(data_deg) ** 2
    prior = normal_spread(seen, np.tile(variance * np.eye(2), (count, 1, 1)), WIDEST_RAD) ** 2
    sigma = np.sqrt(prior * variance / (prior + variance))
    return (prior / (prior + variance) * seen - true) / sigma, np.broadcast_to(sigma, true.shape)


@pytest.mark.parametrize("count", [6, 30, 130])
@pytest.mark.parametrize("spread_deg", [0.03, 0.1, 0.2, 0.3, 1.0])
def test_a_spread_below_what_tilts_show_is_not_taken_for_none(spread_deg: float, count: int) -> None:
    """The likeliest spread is often nothing where 0.1 degrees are hidden in 0.3 of noise: normals would be off by 5 claimed sigma."""
    rng = np.random.default_rng([count, int(100 * spread_deg)])
    score = np.concatenate([shrunk(spread_deg, 0.3, count, rng)[0] for _ in range(1200 // count)])
    # 2400 scores: five standard errors of a rms are 7 %; whole photographs in which little was learnt share the rest
    assert np.sqrt((score**2).mean()) < 1.25
    assert np.abs(score).max() < 7


@pytest.mark.parametrize(("count", "most"), [(6, 0.6), (30, 0.4), (130, 0.3)])
def test_exact_normals_help_the_more_the_more_targets_say_so(count: int, most: float) -> None:
    rng = np.random.default_rng(count)
    sigma = np.concatenate([shrunk(0.0, 0.3, count, rng)[1] for _ in range(20)])
    # of 0.3 degrees that each knows alone
    assert np.degrees(np.sqrt((sigma**2).mean())) < most * 0.3


def test_a_spread_that_shows_is_what_it_is() -> None:
    rng = np.random.default_rng(1)
    tilt = np.radians(0.5) * rng.standard_normal((200, 2))
    spread = normal_spread(tilt, np.tile(np.radians(0.02) ** 2 * np.eye(2), (200, 1, 1)), WIDEST_RAD)
    # a standard deviation from 400 values is known to 3.5 %
    assert np.degrees(spread) == pytest.approx(0.5, rel=0.12)
    bent = tilt.copy()
    bent[0] = np.radians(15.0)
    assert normal_spread(bent, np.tile(np.radians(0.02) ** 2 * np.eye(2), (200, 1, 1)), WIDEST_RAD) == pytest.approx(spread, rel=0.1)
    # too few to learn from, and nothing to learn
    assert normal_spread(tilt[:3], np.tile(1e-8 * np.eye(2), (3, 1, 1)), WIDEST_RAD) == WIDEST_RAD
    none = normal_spread(np.zeros((200, 2)), np.tile(1e-12 * np.eye(2), (200, 1, 1)), WIDEST_RAD)
    assert none == pytest.approx(LEAST_NORMAL_SIGMA_RAD, rel=0.2)
