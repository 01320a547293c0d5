"""A first surface through a grid, from the size of its lattice in the photograph alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dishmap.targets.grid_spline import fit_spline
from dishmap.targets.grid_terms import Terms, of_cells

Array = NDArray[np.float64]

# Least smoothing of the distances; residuals beyond so many medians count nothing; how much of the pitch a surface bends from target to
# target; rounds of all this.
START_SMOOTH, START_CUT, START_BEND, START_ROUNDS = 1e-3, 7.0, 0.05, 5


def start_control(terms: Terms) -> Array:
    """Control points (K, 3) of a first surface, from the size of the lattice around each target.

    Across the line of sight the lattice's derivative, per mm of the print, has the singular values 1 / r and cos(tilt) / r: the larger one
    gives the distance r whatever the tilt.
    """
    spline = terms.spline
    ray = terms.camera.unproject(terms.measured[:, :2])
    seen = np.isfinite(ray).all(axis=1).astype(float)
    ray = np.nan_to_num(ray)
    along = _slopes(terms, fit_spline(spline, terms.lattice, ray, seen, 1e-6))
    along = along - ray[:, :, None] * np.einsum("ni,nia->na", ray, along)[:, None]
    tangent = _slopes(terms, terms.nominal.control_mm)
    frame = np.swapaxes(np.linalg.inv(np.linalg.cholesky(np.swapaxes(tangent, 1, 2) @ tangent)), 1, 2)
    places = ray / np.maximum(np.linalg.svd(along @ frame, compute_uv=False)[:, :1], 1e-9)
    weight, smooth = seen, START_SMOOTH
    # a surface bends by less than a part of the pitch from target to target: the noisier the distances, the stiffer it is taken
    bend = START_BEND * float(np.median(np.linalg.norm(tangent, axis=1)))
    for _ in range(START_ROUNDS):
        control = fit_spline(spline, terms.lattice, places, weight, smooth)
        fitted = np.einsum("nk,nkd->nd", terms.at_targets[:, 0], of_cells(spline, control)[terms.cell])
        gap = np.linalg.norm(places - fitted, axis=1)
        usual = max(float(np.median(gap[seen > 0])), 1e-9)
        weight = seen * (np.clip(1 - (gap / (START_CUT * usual)) ** 2, 0, None) ** 2 + 1e-6)
        smooth = max(START_SMOOTH, (usual / bend) ** 2)
    return control


def _slopes(terms: Terms, control: Array) -> Array:
    """Derivatives (N, D, 2) by the lattice at the targets."""
    return np.swapaxes(terms.at_targets[:, 1:] @ of_cells(terms.spline, control)[terms.cell], 1, 2)
