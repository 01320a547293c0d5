"""Terms of smooth random surfaces: against double sums over points, and against what such surfaces must have."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from dishmap.rf.smooth_terms import candidate_roots, falling_root, matern, matern_root, mean_square, narrowed, terms_for
from dishmap.surface.membrane import disc_points
from dishmap.surface.zernike import zernike_matrix, zernike_terms

TERMS = zernike_terms(6)
# The plain double sum over points stumbles over the kernel's kink where both points are one; the finer the points the less.
KINK = 3e-4
ROUNDING = 1e-12


@pytest.mark.parametrize("length", [0.5, 2.0])
def test_matern_terms_are_projections(length: float) -> None:
    points, weight = disc_points(1.0, 46)
    values = zernike_matrix(TERMS, *points.T) * weight[:, None]
    projection = values.T / (np.pi * mean_square(TERMS))[:, None]
    plain = projection @ matern(cdist(points, points) / length) @ projection.T
    root = matern_root(TERMS, length)
    scale = np.sqrt(np.outer(np.diag(plain), np.diag(plain)))
    assert np.abs((root @ root.T - plain) / scale).max() < KINK
    other = matern_root(TERMS, 1.01 * length)
    assert np.abs((other @ other.T - plain) / scale).max() > KINK


def test_a_matern_field_is_the_same_everywhere() -> None:
    terms = zernike_terms(24)
    places = np.array([[0.0, 0.0], [0.4, -0.3], [-0.7, 0.6], [0.0, 0.97]])
    values = zernike_matrix(terms, *places.T) @ matern_root(terms, 0.7)
    # what degree 24 leaves out is below a thousandth
    assert np.abs(values @ values.T - matern(cdist(places, places) / 0.7)).max() < 1e-3


def test_falling_terms_have_the_asked_mean_square() -> None:
    points, weight = disc_points(1.0, 14)
    variance = np.linspace(2.0, 0.1, len(TERMS))
    field = zernike_matrix(TERMS, *points.T) @ falling_root(TERMS, variance)
    assert np.allclose((field**2 * weight[:, None]).sum(axis=0) / np.pi, variance, rtol=ROUNDING, atol=0)


def test_all_kinds_fall_off_towards_fine_terms() -> None:
    terms = zernike_terms(16)
    n = np.array([n for n, _ in terms])
    for root in candidate_roots(terms, 0.1):
        power = (root**2).sum(axis=1) * mean_square(terms)
        means = [power[n == k].mean() for k in (2, 6, 10, 16)]
        assert means == sorted(means, reverse=True)


@pytest.mark.parametrize("share", [0.6, 0.97])
def test_a_smaller_disc_has_the_same_surface(share: float) -> None:
    rng = np.random.default_rng(1)
    terms = zernike_terms(9)
    coefficients = rng.standard_normal(len(terms))
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    wide = zernike_matrix(terms, share * x, share * y) @ coefficients
    assert np.abs(zernike_matrix(terms, x, y) @ narrowed(terms, share) @ coefficients - wide).max() < 1e3 * ROUNDING


def test_terms_outnumber_targets_until_the_limit() -> None:
    counts = [len(terms_for(n)) for n in (12, 30, 93, 130, 2000)]
    assert counts == sorted(counts)
    for targets, terms in zip((30, 93, 130), counts[1:4], strict=True):
        assert 2 <= terms / targets <= 3
    assert counts[-1] == len(zernike_terms(24))
