"""Real photographs: a plate of printed dots in 14 positions, data/dotplate. How well does its shape repeat?

    scripts/bench dotplate

The plate is known only by its pitch; its camera not at all. So the sizes of the dots and the focal length come from the photographs
themselves: every frame is mapped with a nominal camera, the focal length is that at which the lattice fits best,
and every frame is mapped again. No hint is given: the three odd dots say where the origin and the axes are. Names are checked
by a homography through all dots of a frame: a wrong one would lie a pitch (some 230 px) away.

Repeatability: the plate's shape is one for all frames. Each frame's dots are laid on it by a homography of their own, which any
motion and any focal length are part of, and what remains is compared with the sigmas that were claimed for this frame.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from _common import QUICK, Array, data_folder, print_table, rms

from dishmap.camera.model import Camera
from dishmap.io.camera_file import write_camera
from dishmap.io.images import read_gray
from dishmap.io.pattern_file import write_pattern
from dishmap.pipeline import Map, map_photograph
from dishmap.quality import names
from dishmap.targets.builders import disc, whycon
from dishmap.targets.detect import find_ellipses
from dishmap.targets.identify import identify
from dishmap.targets.pattern import Pattern, Surface

PITCH_MM = 3.5
# Dots that any of the frames shows, counted from the origin dot; the plate is larger to the left and below.
COLUMNS, ROWS = (-2, 8), (-3, 6)
# Dots with a light centre: origin, x axis, y axis.
ODD = ((0, 0), (5, 0), (0, 3))
DOT_PART, ODD_PART, LIGHT_PART = 0.2, 0.22, 0.33
WIDTH_PX, HEIGHT_PX = 2448, 2048
NOMINAL_FOCAL_PX = 10000.0
# Nothing can be said of dots nearer to the border than the pixels that a fit needs around them.
MARGIN_PX = 2.0
SHAPE_ROUNDS = 8


def dot_plate(dot_mm: float, odd_mm: float, light_mm: float) -> Pattern:
    """The plate, its dots' radii given; ids run row by row from the top left."""
    places = [(column, row) for row in range(ROWS[1], ROWS[0] - 1, -1) for column in range(COLUMNS[0], COLUMNS[1] + 1)]
    n = len(places)
    return Pattern(
        "dotplate",
        Surface(),
        {"dot": disc(dot_mm), "odd": whycon(odd_mm, light_mm / odd_mm)},
        np.arange(n),
        tuple("odd" if place in ODD else "dot" for place in places),
        PITCH_MM * np.array([(x, y, 0.0) for x, y in places]),
        np.tile([1.0, 0.0, 0.0], (n, 1)),
        np.tile([0.0, 0.0, 1.0], (n, 1)),
    )


def camera_of(focal_px: float) -> Camera:
    return Camera(WIDTH_PX, HEIGHT_PX, np.full(2, focal_px), np.array([(WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2]))


def homography(source: Array, target: Array) -> Array:
    """Least squares homography from (N, 2) to (N, 2)."""
    return np.asarray(cv2.findHomography(source, target, 0)[0])


def through(h: Array, points: Array) -> Array:
    p = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ h.T
    return np.asarray(p[..., :2] / p[..., 2:])


def survey(files: list[Path]) -> tuple[float, float, Pattern]:
    """Focal length, its sigma, and the plate with the dots' measured sizes, from the ellipses of all frames."""
    plate = dot_plate(*(PITCH_MM * part for part in (DOT_PART, ODD_PART, ODD_PART * LIGHT_PART)))
    objects, images, sizes = [], [], []
    for file in files:
        found = find_ellipses(read_gray(file))
        named = identify(found, plate, camera_of(NOMINAL_FOCAL_PX))
        marks = plate.marks
        xy, uv = marks.center_mm[named.mark], found.center_px[named.detection]
        objects.append(xy.astype(np.float32))
        images.append(uv.astype(np.float32))
        scale = _scale_px_per_mm(homography(xy[:, :2], uv), xy[:, :2])
        size = np.sqrt(found.semi_axes_px.prod(axis=1))
        inside = [[size[k] for k in np.flatnonzero(found.parent == d) if size[k] > 0.2 * size[d]] for d in named.detection]
        odd = np.array([plate.kind_names[t] == "odd" for t in marks.target[named.mark]])
        sizes.append(
            [
                np.median((size[named.detection] / scale)[~odd]),
                np.median((size[named.detection] / scale)[odd]),
                np.median([max(inside[i]) / scale[i] for i in np.flatnonzero(odd)]),
            ]
        )
    fixed = cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags = fixed | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    start = camera_of(NOMINAL_FOCAL_PX).matrix
    _, matrix, _, _, _, sigma, _, _ = cv2.calibrateCameraExtended(objects, images, (WIDTH_PX, HEIGHT_PX), start, np.zeros(5), flags=flags)
    return float(matrix[1, 1]), float(sigma.ravel()[1]), dot_plate(*(float(x) for x in np.median(sizes, axis=0)))


def _scale_px_per_mm(h: Array, xy: Array) -> Array:
    """Root of the area magnification of a homography at (N, 2)."""
    step = 0.01
    along = [(through(h, xy + step * e) - through(h, xy - step * e)) / (2 * step) for e in np.eye(2)]
    return np.sqrt(np.abs(along[0][:, 0] * along[1][:, 1] - along[0][:, 1] * along[1][:, 0]))


def in_view(h: Array, plate: Pattern, camera: Camera) -> Array:
    """Whether each dot (N,) lies wholly inside the image, given the homography from the plate."""
    phi = np.linspace(0, 2 * np.pi, 33)
    circle = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    radius = np.array([plate.kind_of(i).extent_mm for i in range(len(plate))])
    edge = through(h, plate.center_mm[:, None, :2] + radius[:, None, None] * circle)
    return camera.contains(edge, margin_px=MARGIN_PX).all(axis=1)


def common_shape(places: list[tuple[Array, Array]], plate: Pattern) -> tuple[Array, list[Array]]:
    """One flat shape (N, 2) in mm for all frames, and each frame's deviations (K, 2) from it; places: (index, uv) of each frame."""
    shape = plate.center_mm[:, :2].copy()
    for _ in range(SHAPE_ROUNDS):
        laid = [through(homography(uv, shape[index]), uv) for index, uv in places]
        total, count = np.zeros_like(shape), np.zeros(len(shape))
        for (index, _), xy in zip(places, laid, strict=True):
            np.add.at(total, index, xy)
            np.add.at(count, index, 1)
        shape = np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], shape)
    return shape, [xy - shape[index] for (index, _), xy in zip(places, laid, strict=True)]


def report_frames(files: list[Path], results: list[Map], plate: Pattern, camera: Camera) -> None:
    rows = []
    for file, result in zip(files, results, strict=True):
        cloud = result.cloud
        index = cloud.ids
        h = homography(plate.center_mm[index, :2], cloud.center_px)
        off = np.linalg.norm(through(h, plate.center_mm[index, :2]) - cloud.center_px, axis=1)
        whole = in_view(h, plate, camera)
        missed = np.setdiff1d(np.flatnonzero(whole), index)
        flags = Counter(flag for bits in cloud.quality for flag in names(int(bits)).split("|") if flag)
        most = ", ".join(f"{name} {count}" for name, count in flags.most_common())
        rows.append((file.stem, int(whole.sum()), len(index), int((off > 50).sum()), list(map(int, missed)) or "none", off.max(), most))
    header = ("frame", "wholly in view", "measured", "wrong names", "missed ids", "largest px off the lattice", "flags")
    print_table(header, rows, "Found, without a hint")


def report_repeat(files: list[Path], results: list[Map], plate: Pattern) -> None:
    places = [(result.cloud.ids, result.cloud.center_px) for result in results]
    shape, deviations = common_shape(places, plate)
    seen = np.unique(np.concatenate([index for index, _ in places]))
    off = 1000 * rms(shape[seen] - plate.center_mm[seen, :2])
    print(f"\nthe print: rms distance of the dots from a perfect lattice {off:.1f} um per axis")
    # homographies and the shape take some of the scatter away
    total = sum(d.size for d in deviations)
    grow = np.sqrt(total / (total - 8 * len(deviations) - 2 * len(seen)))
    rows, all_px, all_scores = [], [], []
    for file, result, deviation in zip(files, results, deviations, strict=True):
        cloud = result.cloud
        scale = _scale_px_per_mm(homography(shape[cloud.ids], cloud.center_px), shape[cloud.ids])[:, None]
        sigma = np.sqrt(np.einsum("nii->ni", cloud.covariance_px2))
        px = grow * deviation * scale
        all_px.append(px)
        all_scores.append(px / sigma)
        rows.append((file.stem, 1000 * grow * rms(deviation), 1000 * rms(sigma / scale), rms(px), rms(sigma), rms(px / sigma)))
    rows.append(
        ("all", 1000 * grow * rms(np.concatenate(deviations)), "", rms(np.concatenate(all_px)), "", rms(np.concatenate(all_scores)))
    )
    header = ("frame", "repeats to um", "claimed um", "repeats to px", "claimed px", "rms of error/sigma")
    print_table(header, rows, "Repeatability of the plate's shape, per axis (rms over dots)")
    rows = []
    for a in range(len(results) - 1):
        common, i, j = np.intersect1d(results[a].cloud.ids, results[a + 1].cloud.ids, return_indices=True)
        one, two = results[a].cloud, results[a + 1].cloud
        d = through(homography(one.center_px[i], two.center_px[j]), one.center_px[i]) - two.center_px[j]
        claimed = np.sqrt(np.einsum("nii->ni", one.covariance_px2[i]) + np.einsum("nii->ni", two.covariance_px2[j]))
        rows.append((f"{a + 1} to {a + 2}", len(common), rms(d) * np.sqrt(d.size / (d.size - 8)), rms(claimed), np.abs(d).max()))
    print_table(
        ("frames", "dots", "rms px", "claimed px", "largest px"), rows, "From each frame to the next, a homography between them removed"
    )


def report_focal(files: list[Path], plate: Pattern, focal_px: float) -> None:
    """How little the nominal focal length matters to where the dots' centres are."""
    rows = []
    for factor in (0.8, 1.0, 1.25):
        results = [map_photograph(read_gray(file), camera_of(factor * focal_px), plate) for file in files]
        _, deviations = common_shape([(r.cloud.ids, r.cloud.center_px) for r in results], plate)
        first = results[0].cloud
        rows.append((factor * focal_px, len(first), 1000 * rms(np.concatenate(deviations)), np.median(first.position_mm[:, 2])))
    print_table(
        ("focal length px", "measured in the first", "repeats to um", "distance mm"),
        rows,
        "The same with other focal lengths (frames 1, 7, 14)",
    )


def report_program(files: list[Path], results: list[Map], plate: Pattern, camera: Camera) -> None:
    """The same through `dishmap map`, the points read back."""
    program = [sys.executable, "-c", "from dishmap.cli import main; main()"]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        write_pattern(Path(folder) / "plate.json", plate)
        write_camera(Path(folder) / "camera.yaml", camera)
        for file, result in zip(files, results, strict=True):
            out = Path(folder) / file.stem
            options = ["--camera", f"{folder}/camera.yaml", "--pattern", f"{folder}/plate.json", "--out", str(out)]
            run = subprocess.run([*program, "map", str(file), *options], capture_output=True, text=True, check=False)
            if run.returncode:
                rows.append((file.stem, run.returncode, run.stderr.strip()[-160:], ""))
                continue
            points = np.genfromtxt(out / "points.csv", delimiter=",", names=True, usecols=range(15))
            same = np.array_equal(points["id"].astype(int), result.cloud.ids)
            apart = np.abs(np.stack([points["u_px"], points["v_px"]], axis=1) - result.cloud.center_px).max() if same else np.nan
            rows.append((file.stem, run.returncode, len(points), apart))
    print_table(("frame", "exit code", "points", "largest px from the function's"), rows, "Through the program: dishmap map")


def main() -> None:
    folder = data_folder("dotplate")
    if folder is None:
        return
    files = sorted(folder.glob("*.jpg"))
    focal, sigma, plate = survey(files)
    radii = [plate.kinds["dot"].radius_mm[0], *plate.kinds["odd"].radius_mm]
    print(f"focal length {focal:.0f} +- {sigma:.0f} px from the lattice; principal point in the middle, no distortion")
    print("diameters mm: dot {:.3f}, odd dot {:.3f}, its light centre {:.3f}".format(*(2 * r for r in radii)))
    camera = camera_of(focal)
    results = [map_photograph(read_gray(file), camera, plate) for file in files]
    report_frames(files, results, plate, camera)
    report_repeat(files, results, plate)
    if not QUICK:
        report_focal([files[0], files[len(files) // 2 - 1], files[-1]], plate, focal)
    count = 3 if QUICK else len(files)
    report_program(files[:count], results[:count], plate, camera)


if __name__ == "__main__":
    main()
