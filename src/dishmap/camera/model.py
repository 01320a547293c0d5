"""The camera: pinhole with OpenCV's lens distortion, both ways, with Jacobians.

Pixel (0, 0) is the centre of the top-left pixel; the camera frame is x right, y down, z forward. Formulas are those of
the OpenCV documentation ("Camera Calibration and 3D Reconstruction", and `cv2.fisheye`), tested against cv2.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.errors import CameraError

Array = NDArray[np.float64]

LENS_MODELS = ("opencv", "fisheye")
OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
FISHEYE_NAMES = ("k1", "k2", "k3", "k4")
OPENCV_COUNTS = (0, 4, 5, 8, 12)
# The widest half angle at which a lens polynomial is trusted or searched for its fold.
WIDEST_TANGENT = 6.0
WIDEST_FISHEYE_RAD = np.radians(110.0)
UNPROJECT_STEPS = 30
UNPROJECT_TOLERANCE_PX = 1e-9


@dataclass(frozen=True)
class Camera:
    """A calibrated camera.

    width_px, height_px: size of its photographs. focal_px (2,): fx, fy. principal_px (2,): cx, cy.
    distortion: coefficients in OpenCV's order (0, 4, 5, 8 or 12 of them; 4 for `fisheye`). model: `opencv` or `fisheye`.
    covariance: (P, P) of the parameters in the order of `parameter_names`, or None if unknown.
    Raises CameraError for an impossible camera.
    """

    width_px: int
    height_px: int
    focal_px: Array
    principal_px: Array
    distortion: Array = field(default_factory=lambda: np.zeros(0))
    model: str = "opencv"
    covariance: Array | None = None

    def __post_init__(self) -> None:
        for name, size in (("focal_px", 2), ("principal_px", 2)):
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise CameraError(f"a camera's {name} needs {size} finite numbers, not {getattr(self, name)}")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "distortion", np.asarray(self.distortion, dtype=float).reshape(-1))
        self._check()

    def _check(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise CameraError(f"a camera's image size must be positive, not {self.width_px}x{self.height_px}")
        if (self.focal_px <= 0).any():
            raise CameraError(f"a camera's focal length must be positive, not {self.focal_px.tolist()} px")
        if self.model not in LENS_MODELS:
            raise CameraError(f"unknown lens model {self.model!r}; use one of {', '.join(LENS_MODELS)}")
        counts = OPENCV_COUNTS if self.model == "opencv" else (4,)
        if self.distortion.size not in counts:
            raise CameraError(f"the {self.model} lens model takes {' or '.join(map(str, counts))} coefficients, not {self.distortion.size}")
        if not np.isfinite(self.distortion).all():
            raise CameraError("a camera's distortion coefficients must be finite numbers")
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=float)
            n = len(self.parameter_names)
            if covariance.shape != (n, n) or not np.isfinite(covariance).all():
                raise CameraError(f"this camera's covariance must be {n}x{n} finite numbers, not {covariance.shape}")
            object.__setattr__(self, "covariance", covariance)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of `parameters` and `covariance`."""
        names = OPENCV_NAMES if self.model == "opencv" else FISHEYE_NAMES
        return ("fx", "fy", "cx", "cy", *names[: self.distortion.size])

    @property
    def parameters(self) -> Array:
        """fx, fy, cx, cy and the distortion coefficients (P,)."""
        return np.concatenate([self.focal_px, self.principal_px, self.distortion])

    def with_parameters(self, parameters: ArrayLike) -> Camera:
        """Return this camera with other parameters (P,), same size and model, and no covariance."""
        p = np.asarray(parameters, dtype=float)
        return Camera(self.width_px, self.height_px, p[:2], p[2:4], p[4:], self.model)

    @property
    def matrix(self) -> Array:
        """The 3x3 camera matrix."""
        (fx, fy), (cx, cy) = self.focal_px, self.principal_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @cached_property
    def widest(self) -> float:
        """Largest tan(angle) (opencv) or angle in rad (fisheye) off the axis at which the lens is one-to-one."""
        r = np.linspace(0.0, WIDEST_TANGENT if self.model == "opencv" else WIDEST_FISHEYE_RAD, 6001)
        if self.model == "opencv":
            factor, _ = _radial(self.distortion, r * r)
            distorted = r * factor
        else:
            distorted = r * _fisheye_factor(self.distortion, r)[0]
        bad = np.flatnonzero(~(np.diff(distorted) > 0))
        # stop a little before the fold: there the inverse has no precision
        return float(0.999 * r[bad[0]]) if bad.size else float(r[-1])

    def project(self, points_mm: ArrayLike) -> Array:
        """Project points (..., 3) of the camera frame to pixels (..., 2).

        Points behind the camera, or farther off the axis than the lens model holds, give NaN.
        """
        return self._project(points_mm, derivatives=False)[0]

    def project_with_point_jacobian(self, points_mm: ArrayLike) -> tuple[Array, Array]:
        """Project points (..., 3): pixels (..., 2) and d pixels / d point (..., 2, 3)."""
        pixels, by_point, _ = self._project(points_mm, derivatives=True, by_parameter=False)
        return pixels, by_point

    def project_with_jacobians(self, points_mm: ArrayLike) -> tuple[Array, Array, Array]:
        """Project points (..., 3): pixels (..., 2), d pixels / d point (..., 2, 3), d pixels / d parameters (..., 2, P)."""
        return self._project(points_mm, derivatives=True)

    def _project(self, points_mm: ArrayLike, derivatives: bool, by_parameter: bool = True) -> tuple[Array, Array, Array]:
        p = np.asarray(points_mm, dtype=float)
        lens = _opencv_lens if self.model == "opencv" else _fisheye_lens
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            plane, by_point = lens(p, self.distortion, self.widest, derivatives)
        pixels = plane * self.focal_px + self.principal_px
        if not derivatives:
            return pixels, np.empty(0), np.empty(0)
        f = self.focal_px[:, None]
        by_point = by_point * f
        if not by_parameter:
            return pixels, by_point, np.empty(0)
        return pixels, by_point, self._by_parameter(p, plane)

    def _by_parameter(self, p: Array, plane: Array) -> Array:
        if self.model == "opencv":
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                by_coefficient = _by_coefficient(p[..., 0] / p[..., 2], p[..., 1] / p[..., 2], self.distortion)
        else:
            by_coefficient = _fisheye_by_coefficient(p)
        out = np.zeros((*p.shape[:-1], 2, 4 + self.distortion.size))
        out[..., 0, 0], out[..., 1, 1] = plane[..., 0], plane[..., 1]
        out[..., 0, 2] = out[..., 1, 3] = 1.0
        out[..., 4:] = by_coefficient * self.focal_px[:, None]
        return out

    def unproject(self, pixels: ArrayLike) -> Array:
        """Unit rays (..., 3) in the camera frame through pixels (..., 2), to 1e-9 px; NaN where the lens has no inverse.

        Newton's method on the lens alone, so it holds at the edge of wide lenses where OpenCV's fixed-point loop stalls.
        """
        plane = (np.asarray(pixels, dtype=float) - self.principal_px) / self.focal_px
        if self.model == "fisheye":
            return _fisheye_ray(plane, self.distortion, self.widest, UNPROJECT_TOLERANCE_PX / self.focal_px.max())
        xy = _opencv_inverse(plane, self.distortion, self.widest, UNPROJECT_TOLERANCE_PX / self.focal_px.max())
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def contains(self, pixels: ArrayLike, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Where pixels (..., 2) lie inside the image, at least `margin_px` from its border."""
        uv = np.asarray(pixels, dtype=float)
        low, high = margin_px - 0.5, np.array([self.width_px, self.height_px]) - 0.5 - margin_px
        with np.errstate(invalid="ignore"):
            return np.asarray(((uv >= low) & (uv <= high)).all(axis=-1))


def _padded(distortion: Array) -> Array:
    return np.concatenate([distortion, np.zeros(12 - distortion.size)])


def _radial(distortion: Array, r2: Array) -> tuple[Array, Array]:
    """OpenCV's radial factor at squared radius r2, and its derivative by r2."""
    k1, k2, _, _, k3, k4, k5, k6, *_ = _padded(distortion)
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    slope_top, slope_bottom = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
    return top / bottom, (slope_top - top / bottom * slope_bottom) / bottom


def _opencv_lens(p: Array, distortion: Array, widest: float, derivatives: bool) -> tuple[Array, Array]:
    """Distorted plane coordinates (..., 2), by point (..., 2, 3)."""
    z = p[..., 2]
    x, y = p[..., 0] / z, p[..., 1] / z
    bad = ~((z > 0) & (x * x + y * y <= widest * widest))
    plane, by_plane = _distort(x, y, distortion, derivatives)
    plane[bad] = np.nan
    if not derivatives:
        return plane, np.empty(0)
    by_point = np.empty((*p.shape[:-1], 2, 3))
    by_point[..., :2] = by_plane / z[..., None, None]
    by_point[..., 2] = -(by_point[..., 0] * x[..., None] + by_point[..., 1] * y[..., None])
    return plane, by_point


def _distort(x: Array, y: Array, distortion: Array, derivatives: bool = True) -> tuple[Array, Array]:
    """Distorted plane coordinates (..., 2) of undistorted x, y, and their 2x2 Jacobian."""
    _, _, p1, p2, *_, s1, s2, s3, s4 = _padded(distortion)
    r2 = x * x + y * y
    factor, slope = _radial(distortion, r2)
    u = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    v = y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    if not derivatives:
        return np.stack([u, v], axis=-1), np.empty(0)
    jacobian = np.empty((*np.shape(x), 2, 2))
    prism_u, prism_v = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
    jacobian[..., 0, 0] = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_u * x
    jacobian[..., 0, 1] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_u * y
    jacobian[..., 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_v * x
    jacobian[..., 1, 1] = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_v * y
    return np.stack([u, v], axis=-1), jacobian


def _by_coefficient(x: Array, y: Array, distortion: Array) -> Array:
    """Derivative of the distorted plane coordinates by the coefficients (..., 2, K)."""
    r2 = x * x + y * y
    _, _, _, _, _, k4, k5, k6, *_ = _padded(distortion)
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    factor, _ = _radial(distortion, r2)
    out = np.zeros((*np.shape(x), 2, 12))
    for column, power, scale in ((0, 1, 1.0), (1, 2, 1.0), (4, 3, 1.0), (5, 1, -factor), (6, 2, -factor), (7, 3, -factor)):
        term = r2**power * scale / bottom
        out[..., 0, column], out[..., 1, column] = x * term, y * term
    out[..., 0, 2], out[..., 1, 2] = 2 * x * y, r2 + 2 * y * y
    out[..., 0, 3], out[..., 1, 3] = r2 + 2 * x * x, 2 * x * y
    out[..., 0, 8], out[..., 0, 9] = r2, r2 * r2
    out[..., 1, 10], out[..., 1, 11] = r2, r2 * r2
    return out[..., : distortion.size]


def _opencv_inverse(plane: Array, distortion: Array, widest: float, tolerance: float) -> Array:
    if not distortion.any():
        return plane.copy()
    # start from the radial inverse by table, which is inside the basin wherever the lens is one-to-one
    r = np.linspace(0.0, widest, 2001)
    distorted = r * _radial(distortion, r * r)[0]
    radius = np.linalg.norm(plane, axis=-1)
    start = np.interp(radius, distorted, r)
    xy = plane * np.where(radius > 0, start / np.where(radius > 0, radius, 1.0), 1.0)[..., None]
    error = np.full(radius.shape, np.inf)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(UNPROJECT_STEPS):
            value, jacobian = _distort(xy[..., 0], xy[..., 1], distortion)
            residual = plane - value
            error = np.abs(residual).max(axis=-1)
            if not (error > tolerance).any():
                break
            (a, b), (c, d) = (jacobian[..., 0, 0], jacobian[..., 0, 1]), (jacobian[..., 1, 0], jacobian[..., 1, 1])
            e, f = residual[..., 0], residual[..., 1]
            xy = xy + np.stack([d * e - b * f, a * f - c * e], axis=-1) / (a * d - b * c)[..., None]
    bad = ~((error <= tolerance) & (np.linalg.norm(xy, axis=-1) <= widest))
    xy[bad] = np.nan
    return xy


def _fisheye_factor(k: Array, theta: Array) -> tuple[Array, Array]:
    """theta_d / theta and d theta_d / d theta of OpenCV's fisheye model."""
    t2 = theta * theta
    k1, k2, k3, k4 = k
    factor = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    return factor, slope


def _fisheye_lens(p: Array, k: Array, widest: float, derivatives: bool) -> tuple[Array, Array]:
    x, y, z = p[..., 0], p[..., 1], p[..., 2]
    r = np.hypot(x, y)
    theta = np.arctan2(r, z)
    factor, slope = _fisheye_factor(k, theta)
    near = r < 1e-12 * np.maximum(np.abs(z), 1e-300)
    safe = np.where(near, 1.0, r)
    scale = np.where(near, 1.0 / np.where(z == 0, np.nan, z), factor * theta / safe)
    plane = p[..., :2] * scale[..., None]
    plane[~(theta <= widest)] = np.nan
    if not derivatives:
        return plane, np.empty(0)
    unit = np.where(near[..., None], 0.0, p[..., :2] / safe[..., None])
    square = r * r + z * z
    # radial direction grows with d theta_d/d theta * d theta/d r, tangential direction with theta_d / r
    radial = np.where(near, scale, slope * z / square)
    by_point = np.empty((*p.shape[:-1], 2, 3))
    outer = unit[..., :, None] * unit[..., None, :]
    by_point[..., :2] = scale[..., None, None] * np.eye(2) + (radial - scale)[..., None, None] * outer
    by_point[..., 2] = -unit * (slope * r / square)[..., None]
    return plane, by_point


def _fisheye_by_coefficient(p: Array) -> Array:
    r = np.hypot(p[..., 0], p[..., 1])
    unit = p[..., :2] / np.where(r > 0, r, 1.0)[..., None]
    theta = np.arctan2(r, p[..., 2])
    return unit[..., :, None] * np.stack([theta**n for n in (3, 5, 7, 9)], axis=-1)[..., None, :]


def _fisheye_ray(plane: Array, k: Array, widest: float, tolerance: float) -> Array:
    target = np.linalg.norm(plane, axis=-1)
    grid = np.linspace(0.0, widest, 2001)
    theta = np.interp(target, grid * _fisheye_factor(k, grid)[0], grid)
    error = np.full(target.shape, np.inf)
    for _ in range(UNPROJECT_STEPS):
        factor, slope = _fisheye_factor(k, theta)
        error = target - theta * factor
        if not (np.abs(error) > tolerance).any():
            break
        theta = theta + error / slope
    theta = np.where((np.abs(error) <= tolerance) & (theta <= widest), theta, np.nan)
    unit = plane / np.where(target > 0, target, 1.0)[..., None]
    return np.concatenate([unit * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)
