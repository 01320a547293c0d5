"""First poses of flat things, from rays to their points: by the homography from plane to rays (Zhang 2000, section 3.1 and appendix C)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def planar_poses(rays: Array, points_mm: Array, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Rotations (V, 3, 3) and translations (V, 3) camera_from_plane, mm, of V flat things at once.

    rays (M, 3): unit rays to the points points_mm (M, 3) of the things, whose z is left out; thing k has points from starts[k] on.
    """
    counts = np.diff(np.append(starts, len(rays)))
    thing = np.repeat(np.arange(len(starts)), counts)
    middle = np.add.reduceat(points_mm, starts) / counts[:, None]
    plane = points_mm - middle[thing]
    size = np.sqrt(np.add.reduceat((plane**2).sum(axis=1), starts) / counts)
    plane = np.concatenate([plane[:, :2] / size[thing, None], np.ones((len(rays), 1))], axis=1)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    products = across[:, :, None, :, None] * (plane[:, :, None] * plane[:, None, :])[:, None, :, None, :]
    system = np.add.reduceat(products.reshape(-1, 81), starts).reshape(-1, 9, 9)
    homography = np.linalg.eigh(system)[1][:, :, 0].reshape(-1, 3, 3)
    ahead = np.add.reduceat((rays * np.einsum("mij,mj->mi", homography[thing], plane)).sum(axis=1), starts)
    homography *= np.where(ahead < 0, -1.0, 1.0)[:, None, None]
    first, second, third = np.moveaxis(homography, 2, 0)
    scale = np.sqrt(np.maximum(np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1), 1e-300))[:, None]
    u, _, vt = np.linalg.svd(np.stack([first, second, np.cross(first, second) / scale], axis=-1) / scale[..., None])
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotation = u @ vt
    return rotation, size[:, None] * third / scale - np.einsum("vij,vj->vi", rotation, middle)
