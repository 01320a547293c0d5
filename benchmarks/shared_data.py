"""The rendered photographs of data/plate and data/dish against their truth, beside what an OpenCV user would do.

    scripts/bench shared_data

The OpenCV user undistorts nothing: blobs (SimpleBlobDetector) or ellipses of thresholded contours (findContours, fitEllipse), which are the
ring centres of each target, then solvePnP (IPPE) with the camera's distortion. The names are handed to that user: each ring is the
blob nearest to its true place.

Sigma is what the program claims from the photograph's noise alone; the renders' own error (below 0.01 px) is not in it.

The deformed dishes are stretched a little along the surface, and a stretched target looks like a nearer one: the last table tells how
much of the depth error that explains. The stretch is taken from the truth, by the slope of a smooth displacement field.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from _common import QUICK, Array, Errors, covered, data_folder, errors_of, print_table, rms, wrong_names
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.camera.model import Camera
from dishmap.io.camera_file import read_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import read_pattern
from dishmap.io.truth_file import read_truth
from dishmap.pipeline import map_photograph
from dishmap.simulate.truth import Truth
from dishmap.targets.identify import Upright
from dishmap.targets.pattern import Pattern
from dishmap.transforms import angle_between_rad

Gray = NDArray[np.generic]

# A blob farther than this from where its ring truly is belongs to something else.
REACH_PX = 3.0
SMALLEST_VISIBLE = 0.999
# Of the polynomial through displacements: leaves 0.0002 mm of data/dish.
DEGREE = 6


def blobs(image: Gray) -> Array:
    """Centres (B, 2) by SimpleBlobDetector, of any size a ring can have."""
    options = cv2.SimpleBlobDetector_Params()
    options.filterByArea, options.minArea, options.maxArea = True, 20.0, 20000.0
    options.filterByCircularity, options.filterByConvexity, options.filterByInertia = False, False, False
    # a ring's middle is light, so its colour there says nothing
    options.filterByColor = False
    options.minDistBetweenBlobs = 3.0
    return np.array([k.pt for k in cv2.SimpleBlobDetector_create(options).detect(image)]).reshape(-1, 2)


def ellipses(image: Gray) -> Array:
    """Centres (E, 2) of ellipses through all long contours of the image thresholded by Otsu."""
    _, binary = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.array([cv2.fitEllipseDirect(c)[0] for c in contours if 12 <= len(c) <= 1000]).reshape(-1, 2)


def solve(centers: Array, camera: Camera, pattern: Pattern, truth: Truth) -> tuple[Array, Array, Array]:
    """Index (K,), position (K, 3) and normal (K, 3) of targets by solvePnP over the ring centres that were found.

    Circles about one centre (outer and inner edge) are averaged. Of IPPE's two poses the better is taken.
    """
    marks = pattern.marks
    tree = cKDTree(centers)
    index, position, normal = [], [], []
    for i in range(len(pattern)):
        local = pattern.kind_of(i).center_mm[marks.circle[marks.target == i]]
        across = np.array([1.0, -1.0, -1.0])
        along = _axes_in_camera(pattern, truth, i)
        expected = camera.project(truth.center_mm[i] + local @ along[:2])
        near = [tree.query_ball_point(p, REACH_PX) for p in expected]
        if not all(near):
            continue
        seen = np.array([centers[n].mean(axis=0) for n in near])
        flat = np.column_stack([local, np.zeros(len(local))])
        ok, turn, shift = cv2.solvePnP(flat, seen, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_IPPE)
        if not ok:
            continue
        up = cv2.Rodrigues(turn)[0][:, 2]
        index.append(i)
        position.append(shift.ravel())
        normal.append(up if across @ up * (across @ along[2]) > 0 else -up)
    return np.array(index), np.array(position), np.array(normal)


def _axes_in_camera(pattern: Pattern, truth: Truth, index: int) -> Array:
    """Rows x, y, normal of a target in the camera frame: the camera looks along -z with y up, to within a few degrees."""
    x = np.array([1.0, -1.0, -1.0]) * pattern.x_axis[index]
    normal = truth.normal[index]
    x = x - (x @ normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal])


def ours(image: Gray, camera: Camera, pattern: Pattern, truth: Truth) -> tuple[tuple[object, ...], Errors]:
    start = time.perf_counter()
    result = map_photograph(image, camera, pattern, Upright())
    seconds = time.perf_counter() - start
    errors = errors_of(result, truth)
    z, uv = errors.position_mm[:, 2], errors.center_px
    whole = int((truth.visible_fraction > SMALLEST_VISIBLE).sum())
    row = (
        f"{len(errors)}/{whole}",
        wrong_names(result, truth, camera),
        rms(np.linalg.norm(uv, axis=1)),
        rms(np.linalg.norm(errors.sigma_px, axis=1)),
        rms(z),
        rms(errors.sigma_mm[:, 2]),
        z.mean(),
        covered(errors.scores[:, 2]),
        covered(errors.scores[:, 3:]),
        float(np.degrees(np.median(errors.normal_rad))),
        rms(np.degrees(errors.sigma_normal_rad)),
        int((errors.quality > 0).sum()),
        round(seconds, 2),
    )
    return row, errors


def peers(image: Gray, camera: Camera, pattern: Pattern, truth: Truth) -> list[tuple[object, ...]]:
    rows = []
    for name, find in (("blobs + solvePnP", blobs), ("ellipses + solvePnP", ellipses)):
        start = time.perf_counter()
        centers = find(image)
        index, position, normal = solve(centers, camera, pattern, truth)
        seconds = time.perf_counter() - start
        if not len(index):
            rows.append((name, "0", *("",) * 5, round(seconds, 2)))
            continue
        uv = camera.project(position) - truth.center_px[index]
        z = position[:, 2] - truth.center_mm[index, 2]
        angle = np.degrees(np.median(angle_between_rad(normal, truth.normal[index])))
        found = f"{len(index)}/{len(pattern)}"
        rows.append((name, found, rms(np.linalg.norm(uv, axis=1)), rms(z), z.mean(), rms(z - z.mean()), angle, round(seconds, 2)))
    return rows


def stretch(before: Truth, after: Truth) -> Array:
    """Principal stretches minus one (N, 2) of the surface from one state to another, at the targets.

    The displacement is a polynomial in x and y; its slope along two tangents gives the metric of the surface afterwards.
    """
    scale = np.abs(before.center_mm[:, :2] - before.center_mm[:, :2].mean(axis=0)).max()
    x, y = (before.center_mm[:, :2] - before.center_mm[:, :2].mean(axis=0)).T / scale
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    columns = np.stack([x**i * y**j for i, j in powers], axis=1)
    c = np.linalg.lstsq(columns, after.center_mm - before.center_mm, rcond=None)[0]
    by_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], axis=1) @ c / scale
    by_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], axis=1) @ c / scale
    slope = -before.normal[:, :2] / before.normal[:, 2:]
    one, zero = np.ones(len(x)), np.zeros(len(x))
    tangents = np.stack([np.stack([one, zero, slope[:, 0]], axis=1), np.stack([zero, one, slope[:, 1]], axis=1)], axis=1)
    moved = tangents + np.stack([by_x, by_y], axis=1)
    root = np.linalg.inv(np.linalg.cholesky(tangents @ np.swapaxes(tangents, 1, 2)))
    metric = root @ (moved @ np.swapaxes(moved, 1, 2)) @ np.swapaxes(root, 1, 2)
    return np.sqrt(np.linalg.eigvalsh(metric)) - 1


def stretch_rows(truths: Mapping[str, Truth], found: dict[str, tuple[Errors, Array]]) -> list[tuple[object, ...]]:
    """How errors follow the stretch of each state against the first; found: errors and index into the truth, by image."""
    reference = truths[next(iter(truths))]
    rows = []
    for name, (errors, index) in found.items():
        s = stretch(reference, truths[name])[index]
        mean, unequal = s.mean(axis=1), s[:, 1] - s[:, 0]
        z = errors.position_mm[:, 2]
        expected = -truths[name].center_mm[index, 2] * mean
        if rms(mean) < 1e-7:
            continue
        together = np.corrcoef(z, expected)[0, 1], np.corrcoef(errors.normal_rad, unequal)[0, 1]
        rows.append(
            (name, 1e6 * rms(mean), 1e6 * rms(unequal), rms(z), rms(expected), together[0], rms(errors.sigma_mm[:, 2]), together[1])
        )
    return rows


def one_set(folder: Path) -> None:
    camera, pattern = read_camera(folder / "camera.yaml"), read_pattern(folder / "pattern.json")
    truths = read_truth(folder / "truth.csv")
    names = list(truths)[:2] if QUICK else list(truths)
    mine, theirs, found = [], [], {}
    for name in names:
        image, truth = read_gray(folder / name), truths[name]
        row, errors = ours(image, camera, pattern, truth)
        mine.append((name, *row))
        found[name] = errors, np.flatnonzero(np.isin(truth.ids, errors.ids))
        z = errors.position_mm[:, 2]
        uv = rms(np.linalg.norm(errors.center_px, axis=1))
        theirs.append((name, "dishmap", f"{len(errors)}/{len(pattern)}", uv, rms(z), z.mean(), rms(z - z.mean()), row[9], row[-1]))
        theirs += [(name, *peer) for peer in peers(image, camera, pattern, truth)]
    header = (
        "image",
        "found",
        "wrong",
        "centre px",
        "sigma",
        "depth mm",
        "sigma",
        "bias",
        "z in 95 %",
        "uv in 95 %",
        "normal deg",
        "sigma",
        "flags",
        "s",
    )
    print_table(header, mine, f"data/{folder.name}: rms errors beside claimed sigmas (centre in 2D; normal: median error, rms sigma)")
    header = ("image", "method", "found", "centre px", "depth mm", "bias mm", "scatter mm", "normal deg", "s")
    print_table(header, theirs, f"data/{folder.name}: beside OpenCV, whose user is told the names")
    rows = stretch_rows(truths, found)
    if rows and not QUICK:
        header = ("image", "stretch ppm", "unequal ppm", "depth mm", "by stretch mm", "correlation", "claimed mm", "normal with unequal")
        print_table(header, rows, f"data/{folder.name}: what stretching of the surface does to single targets")


def main() -> None:
    for name in ("plate", "dish"):
        folder = data_folder(name)
        if folder is not None:
            one_set(folder)


if __name__ == "__main__":
    main()
