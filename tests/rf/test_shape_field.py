"""The statistical shape: exact without noise, true intervals with it, honest where no target is, not dragged by a loose one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.quality import Quality
from dishmap.rf.antenna import Reflector
from dishmap.rf.deformation import displacement
from dishmap.rf.shape_field import ShapeField, TargetValues, deformation_of, draws, extrapolated, shape_field, sigma_at
from dishmap.rf.smooth_terms import matern
from dishmap.simulate.deform import Bump, Deformation, Gores, ZernikeTerm, displacement_mm
from dishmap.surface.membrane import disc_points
from dishmap.surface.zernike import zernike_terms, zernike_xy

REFLECTOR = Reflector(600.0, 300.0)
RADIUS_MM = 300.0
# A normal variable stays within this many sigmas with a probability of 95 %.
Z95 = 1.959964


def spread_places(count: int) -> np.ndarray:
    """Places (N, 2) spread evenly over the aperture: Vogel's sunflower."""
    k = np.arange(count) + 0.5
    return RADIUS_MM * np.sqrt(k / count)[:, None] * np.stack([np.cos(2.3999632 * k), np.sin(2.3999632 * k)], axis=1)


PLACES = spread_places(64)
ZERNIKES = Deformation(zernike=(ZernikeTerm(2, 2, 0.5), ZernikeTerm(3, -1, 0.2), ZernikeTerm(4, 0, -0.3), ZernikeTerm(5, 3, 0.1)))
BETWEEN = disc_points(RADIUS_MM, 24)[0]
# Of fields of 0.5 mm at 64 targets, anywhere on the aperture; the spacing is an eighth of its diameter.
EXACT_MM = 2e-3


def targets(value_mm: np.ndarray, sigma_mm: float = 0.0, factor_mm: np.ndarray | None = None, settled: bool = False) -> TargetValues:
    n = len(value_mm)
    factor = np.zeros((n, 0)) if factor_mm is None else factor_mm
    return TargetValues(np.arange(n), PLACES[:n], value_mm, factor, np.full(n, sigma_mm**2), np.zeros(n, np.int64), settled)


def chosen(values: TargetValues, keep: np.ndarray) -> TargetValues:
    names = ("ids", "places_mm", "value_mm", "factor_mm", "own_mm2", "quality")
    return replace(values, **{name: getattr(values, name)[keep] for name in names})


def error_mm(field: ShapeField, state: Deformation, xy_mm: np.ndarray) -> np.ndarray:
    return displacement(deformation_of(field), xy_mm)[0] - displacement_mm(state, xy_mm, RADIUS_MM)


@pytest.mark.parametrize("settled", [True, False])
def test_few_terms_without_noise_come_back(settled: bool) -> None:
    field = shape_field(targets(displacement_mm(ZERNIKES, PLACES, RADIUS_MM), settled=settled), REFLECTOR)
    assert np.abs(error_mm(field, ZERNIKES, BETWEEN)).max() < EXACT_MM
    assert field.own_mm < 1e-4
    other = replace(ZERNIKES, zernike=(*ZERNIKES.zernike, ZernikeTerm(6, 6, 2 * EXACT_MM)))
    assert np.abs(error_mm(field, other, BETWEEN)).max() > EXACT_MM


@pytest.mark.parametrize("settled", [True, False])
def test_broad_terms_are_never_held_back(settled: bool) -> None:
    # a rise, tilt, defocus, astigmatism and coma that dwarf all else
    broad = Deformation(zernike=tuple(ZernikeTerm(n, m, 20.0 - n - m) for n, m in [*zernike_terms(2), (3, -1), (3, 1)]))
    rng = np.random.default_rng(2)
    value = displacement_mm(broad, PLACES, RADIUS_MM) + rng.normal(0, 0.01, len(PLACES))
    field = shape_field(targets(value, 0.0 if settled else 0.01, settled=settled), REFLECTOR)
    found = dict(zip(field.terms, field.mean_mm, strict=True))
    # 64 targets of 0.01 mm
    assert max(abs(found[term.n, term.m] - term.size_mm) for term in broad.zernike) < 0.015


@pytest.mark.parametrize("settled", [True, False])
def test_no_change_at_all(settled: bool) -> None:
    field = shape_field(targets(np.zeros(len(PLACES)), settled=settled), REFLECTOR)
    assert np.abs(field.mean_mm).max() == 0
    assert sigma_at(field, BETWEEN).max() < 1e-6


def settled_values(state: Deformation, rng: np.random.Generator, sigma_mm: float, length_mm: float) -> TargetValues:
    """What an estimate with a smooth prior of its own (Matern, amplitude and length known) thinks of noisy values."""
    true = displacement_mm(state, PLACES, RADIUS_MM)
    noise = np.diag(np.full(len(PLACES), sigma_mm**2))
    near = np.linalg.norm(PLACES[:, None] - PLACES, axis=-1) / length_mm
    prior = max(float(true.std()), sigma_mm) ** 2 * (matern(near) + 100.0) + 1e-12 * np.eye(len(PLACES))
    gain = prior @ np.linalg.inv(prior + noise)
    values, vectors = np.linalg.eigh(prior - gain @ prior)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    return targets(gain @ (true + rng.normal(0, sigma_mm, len(true))), 0.0, factor, settled=True)


def measured_values(state: Deformation, rng: np.random.Generator, sigma_mm: float) -> TargetValues:
    """Noisy values that share errors of a few broad kinds, as those of a calibration."""
    x, y = PLACES.T / RADIUS_MM
    factor = sigma_mm * np.stack([np.ones_like(x), x**2 + y**2, np.sin(2 * x + 1)], axis=1)
    noise = rng.normal(0, sigma_mm, len(x)) + factor @ rng.standard_normal(3)
    return targets(displacement_mm(state, PLACES, RADIUS_MM) + noise, sigma_mm, factor)


def random_state(kind: str, rng: np.random.Generator) -> Deformation:
    size = 10 ** rng.uniform(-1.5, 0)
    if kind == "zernike":
        terms = [t for t in zernike_terms(7) if t[0] > 1]
        fall = rng.uniform(2, 4)
        return Deformation(zernike=tuple(ZernikeTerm(n, m, float(size * rng.normal() * (n + 1) ** (0.5 - fall / 2))) for n, m in terms))
    if kind == "bumps":
        places = rng.uniform(-200, 200, (2, 2))
        return Deformation(
            bumps=tuple(Bump((float(x), float(y)), float(rng.uniform(60, 120)), float(size * rng.normal())) for x, y in places)
        )
    return Deformation(gores=(Gores(int(rng.integers(4, 8)), float(size * rng.normal())),))


@pytest.mark.parametrize("kind", ["zernike", "bumps", "gores"])
@pytest.mark.parametrize("settled", [True, False])
def test_intervals_hold_the_truth(kind: str, settled: bool) -> None:
    rng = np.random.default_rng(7)
    inside, coefficients = [], []
    points, weight = disc_points(RADIUS_MM, 40)
    for _ in range(20):
        state = random_state(kind, rng)
        values = settled_values(state, rng, 0.01, 80.0) if settled else measured_values(state, rng, 0.01)
        field = shape_field(values, REFLECTOR)
        radius, turn = RADIUS_MM * np.sqrt(rng.random(100)), 2 * np.pi * rng.random(100)
        places = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)
        inside.append(np.mean(np.abs(error_mm(field, state, places)) < Z95 * sigma_at(field, places)))
        for n, m in ((2, 0), (3, -1), (3, 1)):
            term = zernike_xy(n, m, *points.T / RADIUS_MM)
            true = (term * weight * displacement_mm(state, points, RADIUS_MM)).sum() / (term**2 * weight).sum()
            row = field.terms.index((n, m))
            coefficients.append((field.mean_mm[row] - true) / np.sqrt((field.factor_mm[row] ** 2).sum()))
    # 20 surfaces, whose points are not independent: three standard errors of a share of 0.95 are 0.06 and more
    assert np.mean(inside) > 0.88
    assert np.mean(np.abs(coefficients) < Z95) > 0.85


def test_draws_have_the_covariance() -> None:
    rng = np.random.default_rng(3)
    field = shape_field(measured_values(ZERNIKES, rng, 0.02), REFLECTOR)
    some = draws(field, rng, 300)
    assert some.shape == (300, len(field.terms))
    places = BETWEEN[::40]
    values = np.stack([displacement(deformation_of(field, row), places)[0] for row in some])
    sigma = sigma_at(field, places)
    # of 300 draws: standard errors of a mean 0.058 sigma, of a sigma 4 %
    assert np.abs((values.mean(axis=0) - displacement(deformation_of(field), places)[0]) / sigma).max() < 0.25
    assert np.abs(values.std(axis=0) / sigma - 1).max() < 0.18


@pytest.mark.parametrize("missing", ["sector", "rim"])
def test_sigma_grows_where_targets_are_missing(missing: str) -> None:
    full = measured_values(ZERNIKES, np.random.default_rng(4), 0.01)
    turn, radius = np.arctan2(PLACES[:, 1], PLACES[:, 0]), np.linalg.norm(PLACES, axis=1)
    keep = np.abs(turn) > 0.6 if missing == "sector" else radius < 200.0
    field = shape_field(chosen(full, keep), REFLECTOR)
    gap, held = PLACES[~keep & (radius > 150)], PLACES[keep & (radius < 150)]
    far = extrapolated(field, gap)
    assert far.mean() > 0.4
    assert not extrapolated(field, held).any()
    assert np.median(sigma_at(field, gap[far])) > 4 * np.median(sigma_at(field, held))
    assert np.median(sigma_at(field, gap[far])) > 4 * np.median(sigma_at(shape_field(full, REFLECTOR), gap[far]))
    # 30 places that go together
    assert np.abs(error_mm(field, ZERNIKES, gap) / sigma_at(field, gap)).max() < 4.0
    if missing == "rim":
        outward = sigma_at(field, np.array([[210.0, 0.0], [240.0, 0.0], [270.0, 0.0], [299.0, 0.0]]))
        assert (np.diff(outward) > 0).all()


def test_between_targets_nothing_is_extrapolated() -> None:
    full = targets(np.zeros(len(PLACES)))
    assert not extrapolated(shape_field(full, REFLECTOR), BETWEEN).any()
    # one target missing is no gap, seven are
    holes = np.argsort(np.linalg.norm(PLACES - [90.0, 60.0], axis=1))
    one = shape_field(chosen(full, np.setdiff1d(np.arange(len(PLACES)), holes[:1])), REFLECTOR)
    seven = shape_field(chosen(full, np.setdiff1d(np.arange(len(PLACES)), holes[:7])), REFLECTOR)
    assert not extrapolated(one, BETWEEN).any()
    assert extrapolated(seven, PLACES[holes[:1]]).all()
    assert not extrapolated(seven, PLACES[holes[10:]]).any()


@pytest.mark.parametrize("settled", [True, False])
def test_a_loose_target_does_not_drag(settled: bool) -> None:
    rng = np.random.default_rng(5)
    values = settled_values(ZERNIKES, rng, 0.005, 150.0) if settled else measured_values(ZERNIKES, rng, 0.005)
    clean = displacement(deformation_of(shape_field(values, REFLECTOR)), BETWEEN)[0]
    value, quality = values.value_mm.copy(), values.quality.copy()
    value[40] += 3.0
    quality[40] = int(Quality.OFF_SURFACE)
    loose = shape_field(replace(values, value_mm=value, quality=quality), REFLECTOR)
    assert loose.left_out == (40,)
    assert len(loose.places_mm) == len(PLACES) - 1
    assert np.abs(displacement(deformation_of(loose), BETWEEN)[0] - clean).max() < 0.05
    dragged = shape_field(replace(values, value_mm=value), REFLECTOR)
    assert np.abs(displacement(deformation_of(dragged), BETWEEN)[0] - clean).max() > 0.05
    # when many moved apart from their neighbours it is the surface that is strange
    assert shape_field(replace(values, quality=np.full(len(PLACES), int(Quality.OFF_SURFACE))), REFLECTOR).left_out == ()


def test_targets_a_little_outside_count() -> None:
    field = shape_field(targets(displacement_mm(ZERNIKES, PLACES, RADIUS_MM)), Reflector(580.0, 300.0))
    assert field.radius_mm == 290.0
    assert np.linalg.norm(field.places_mm, axis=1).max() > 290.0
    inside = BETWEEN[np.linalg.norm(BETWEEN, axis=1) < 290]
    assert np.abs(error_mm(field, ZERNIKES, inside)).max() < EXACT_MM


def test_an_offset_aperture() -> None:
    offset = Reflector(600.0, 500.0, offset_mm=400.0)
    shift = np.array([400.0, 0.0])
    field = shape_field(replace(targets(displacement_mm(ZERNIKES, PLACES, RADIUS_MM)), places_mm=PLACES + shift), offset)
    assert field.center_mm.tolist() == [400.0, 0.0]
    found = displacement(deformation_of(field), BETWEEN + shift)[0]
    assert np.abs(found - displacement_mm(ZERNIKES, BETWEEN, RADIUS_MM)).max() < EXACT_MM


def test_what_is_no_shape_is_refused() -> None:
    whole = targets(np.zeros(len(PLACES)))
    with pytest.raises(InputError, match=r"target 63 lies 298\.\d mm from the centre \(0, 0\) mm of the aperture, whose radius is 250 mm"):
        shape_field(whole, Reflector(500.0, 300.0))
    with pytest.raises(InputError, match="5 targets are too few"):
        shape_field(targets(np.zeros(5)), REFLECTOR)
    line = np.stack([np.linspace(-200, 200, len(PLACES)), np.zeros(len(PLACES))], axis=1)
    with pytest.raises(InputError, match="lie in a line"):
        shape_field(replace(whole, places_mm=line), REFLECTOR)
    nearly = line + np.random.default_rng(1).normal(0, 0.1, line.shape)
    with pytest.raises(InputError, match="do not show a tilt"):
        shape_field(replace(whole, places_mm=nearly), REFLECTOR)
