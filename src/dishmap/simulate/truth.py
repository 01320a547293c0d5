"""What is true of every target in a simulated photograph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.simulate.forward import centers_and_normals, target_displacement_mm
from dishmap.simulate.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """Truth of N targets, in the order of the pattern.

    ids (N,); center_mm and normal (N, 3) in the camera frame, the normal on the printed side; center_px (N, 2), NaN for a
    centre outside the lens's field; visible_fraction (N,): share of the ink inside the image, not occluded and not
    saturated; for a crossing of lines that of the ink within half a step of the lattice along both, were they unbroken;
    displacement_mm (N,): along the nominal normal, without expansion and rigid motion.
    """

    ids: NDArray[np.int64]
    center_mm: Array
    normal: Array
    center_px: Array
    visible_fraction: Array
    displacement_mm: Array

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Simulation:
    """A photograph (height, width), uint8 or uint16, and the truth of its targets."""

    image: NDArray[np.uint8] | NDArray[np.uint16]
    truth: Truth


def truth_of(scene: Scene, visible_fraction: Array) -> Truth:
    """Truth of a scene, given the visible fraction (N,) that the rendering found."""
    center, normal = centers_and_normals(scene)
    return Truth(
        ids=scene.pattern.ids.copy(),
        center_mm=center,
        normal=normal,
        center_px=scene.camera.project(center),
        visible_fraction=visible_fraction,
        displacement_mm=target_displacement_mm(scene),
    )
