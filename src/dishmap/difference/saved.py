"""A difference as it is kept for later: the motion and the change of shape of each target, with their whole covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.difference.difference_map import DifferenceMap, Significance
from dishmap.targets.pattern import Pattern, Surface
from dishmap.transforms import Pose

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Share of the whole variance that may go from the factor's weakest columns to the targets' own variances.
LEFT_TO_OWN = 1e-9


@dataclass(frozen=True)
class SavedDifference:
    """What N targets did between two states, in mm.

    ids (N,); nominal_mm, normal (N, 3) in the dish frame; displacement_mm, shape_mm (N,): along the normal, positive towards the focus,
    whole and without the rigid motion; their covariance is factor factor^T + diag(own) with factors (N, R) and own variances (N,) in mm^2;
    quality (N,): bits. surface: the pattern's nominal surface; rigid_motion: dish_from_dish, of the surface in the reference's dish frame,
    and its covariance (6, 6) of (move mm, turn rad); significance of the change; converged: the estimate did.
    """

    ids: Ints
    nominal_mm: Array
    normal: Array
    displacement_mm: Array
    shape_mm: Array
    displacement_factor: Array
    displacement_own_mm2: Array
    shape_factor: Array
    shape_own_mm2: Array
    quality: Ints
    surface: Surface
    rigid_motion: Pose
    rigid_covariance: Array
    significance: Significance
    converged: bool

    def __len__(self) -> int:
        return len(self.ids)


def saved_difference(joint: DifferenceMap, pattern: Pattern) -> SavedDifference:
    """What is kept of a joint estimate on this pattern; factors get as few columns as their covariances allow."""
    moved_factor, moved_own = compact(joint.displacement_factor, joint.displacement_own_mm2)
    shape_factor, shape_own = compact(joint.shape_factor, joint.shape_own_mm2)
    return SavedDifference(
        ids=joint.ids,
        nominal_mm=joint.nominal_mm,
        normal=joint.normal,
        displacement_mm=joint.displacement_mm,
        shape_mm=joint.shape_mm,
        displacement_factor=moved_factor,
        displacement_own_mm2=moved_own,
        shape_factor=shape_factor,
        shape_own_mm2=shape_own,
        quality=joint.quality,
        surface=pattern.surface,
        rigid_motion=joint.rigid_motion,
        rigid_covariance=joint.rigid_covariance,
        significance=joint.significance,
        converged=joint.converged,
    )


def compact(factor: Array, own_mm2: Array) -> tuple[Array, Array]:
    """A factor (N, R') with fewer columns and own variances (N,) of nearly the same covariance; each variance stays what it was.

    Columns are the principal axes of the covariance; the weakest, which hold LEFT_TO_OWN of its trace, become independent parts.
    """
    left, size, _ = np.linalg.svd(factor, full_matrices=False)
    columns = left * size
    weakest_first = np.cumsum(size[::-1] ** 2)[::-1]
    keep = weakest_first > LEFT_TO_OWN * (weakest_first[0] if len(size) else 0.0)
    return columns[:, keep], own_mm2 + (columns[:, ~keep] ** 2).sum(axis=1)
