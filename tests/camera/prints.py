"""Photographs of a printed sheet: the PDF rendered by poppler, put on paper by a printer with errors of scale, seen by a whole camera."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import numpy as np
from boards import poses_in_view
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from dishmap.camera.model import Camera
from dishmap.transforms import Pose

Array = NDArray[np.float64]

INCH_MM, DPI = 25.4, 150
# Samples a side of a pixel, blur of the lens in px, and noise of the sensor in grey levels.
SAMPLES, BLUR_PX, NOISE = 4, 0.6, 1.0


def page_of(pdf: Path) -> NDArray[np.uint8]:
    """The first page of a PDF file as a grey picture of DPI."""
    subprocess.run(["pdftoppm", "-r", str(DPI), "-gray", "-singlefile", str(pdf), str(pdf.with_suffix(""))], check=True)
    return np.asarray(cv2.imread(str(pdf.with_suffix(".pgm")), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def photographed(page: NDArray[np.uint8], camera: Camera, pose: Pose, scale: tuple[float, float], rng: np.random.Generator) -> Array:
    """A photograph of a printed page whose middle is the pose's origin, x to the right and y up on the paper."""
    fine = (np.arange(camera.width_px * SAMPLES) + 0.5) / SAMPLES - 0.5, (np.arange(camera.height_px * SAMPLES) + 0.5) / SAMPLES - 0.5
    # rays are smooth: every eighth pixel says enough
    coarse = np.arange(-8, camera.width_px + 17, 8.0), np.arange(-8, camera.height_px + 17, 8.0)
    rays = camera.unproject(np.stack(np.meshgrid(*coarse), axis=-1)) @ pose.rotation
    origin = -pose.translation_mm @ pose.rotation
    flat = origin[:2] - rays[..., :2] * (origin[2] / rays[..., 2:])
    middle = (np.array(page.shape[::-1]) - 1) / 2
    at = middle + flat * [1, -1] / np.array(scale) * DPI / INCH_MM
    u, v = (RectBivariateSpline(*coarse[::-1], at[..., k])(*fine[::-1]).astype(np.float32) for k in (0, 1))
    seen = cv2.remap(page, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90).astype(np.float32)
    seen = cv2.resize(cv2.GaussianBlur(seen, (0, 0), BLUR_PX * SAMPLES), (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    return np.asarray(20 + 0.75 * seen + rng.normal(size=seen.shape) * NOISE)


def print_photographs(pdf: Path, camera: Camera, count: int, scale: tuple[float, float] = (1.0, 1.0)) -> list[Path]:
    """Files, beside a PDF file, of photographs of its first page, printed with these scales along x and y."""
    rng, page = np.random.default_rng(0), page_of(pdf)
    half = np.array(page.shape[::-1]) * INCH_MM / DPI / 2 * 0.8
    outline = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    names = []
    for number, pose in enumerate(poses_in_view(rng, camera, outline, count)):
        names.append(pdf.with_name(f"photo{number}.png"))
        cv2.imwrite(str(names[-1]), np.clip(np.rint(photographed(page, camera, pose, scale, rng)), 0, 255).astype(np.uint8))
    return names
