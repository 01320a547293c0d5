"""Taking a lens out of points and pictures: the paper's T(im), section 4.2.

Measuring does not go through here: points are corrected through the camera model where they are used, and photographs are
never resampled for a measurement. T(im) is for people, and for the paper's own method.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dishmap.camera.model import Camera
from dishmap.errors import CameraError, ImageError

Array = NDArray[np.float64]

# Pixels of the map made at a time: small enough for the processor's cache, which more than halves the time.
BAND_PX = 20_000
# cv2.remap keeps pixel numbers in 16 bits
LARGEST_SIDE_PX = 32_766
DTYPES = (np.uint8, np.uint16, np.float32)


def pinhole_camera(camera: Camera, zoom: float = 1.0) -> Camera:
    """Return `camera` without its lens distortion: same size and principal point, focal length times `zoom`.

    With zoom 1 the middle of the picture keeps its scale and a barrel lens's corners fall outside; a smaller zoom brings
    them in. Raises CameraError when zoom is not positive.
    """
    if not (np.isfinite(zoom) and zoom > 0):
        raise CameraError(f"zoom must be a positive number, not {zoom}")
    return Camera(camera.width_px, camera.height_px, camera.focal_px * zoom, camera.principal_px)


def undistort_points(camera: Camera, pixels: ArrayLike, into: Camera | None = None) -> Array:
    """Where points at `pixels` (..., 2) of `camera` lie in the picture of another camera (..., 2) at the same place.

    `into`: the other camera, by default `pinhole_camera(camera)`. NaN where either lens has no such ray.
    """
    return (into or pinhole_camera(camera)).project(camera.unproject(pixels))


def undistort_image(camera: Camera, image: NDArray[np.generic], into: Camera | None = None) -> tuple[NDArray[np.generic], Camera]:
    """Resample a photograph to the picture of another camera at the same place: the paper's T(im).

    image: (height, width) or (height, width, channels), uint8, uint16 or float32, as the camera took it.
    into: the other camera, by default `pinhole_camera(camera)`. Returns the picture, 0 where the photograph has nothing,
    and its camera. Interpolation is Lanczos over 8x8 px at positions that OpenCV rounds to 1/32 px: small spots keep their
    centroid to about 0.02 px, as with bilinear interpolation, and lose less of their height.
    Raises CameraError when the size is not the camera's, ImageError for other types and sizes that cannot be resampled.
    """
    check_size(camera, image)
    if image.dtype not in DTYPES or image.ndim not in (2, 3):
        raise ImageError(f"a picture to undistort must be 8-bit, 16-bit or float32 with 2 or 3 axes, not {image.dtype} {image.shape}")
    if max(image.shape[:2]) > LARGEST_SIDE_PX:
        raise ImageError(f"pictures up to {LARGEST_SIDE_PX} px on a side can be undistorted, not {image.shape[1]}x{image.shape[0]}")
    target = into or pinhole_camera(camera)
    out = np.zeros((target.height_px, target.width_px, *image.shape[2:]), dtype=image.dtype)
    columns = np.arange(target.width_px, dtype=float)
    step = max(1, BAND_PX // target.width_px)
    for top in range(0, target.height_px, step):
        rows = np.arange(top, min(top + step, target.height_px), dtype=float)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        # -9 is outside for any kernel, which is what a ray without a pixel needs
        source = np.nan_to_num(camera.project(target.unproject(grid)), nan=-9.0).astype(np.float32)
        band = cv2.remap(image, source, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_CONSTANT, borderValue=0)  # type: ignore[call-overload]
        out[top : top + len(rows)] = band.reshape(out[top : top + len(rows)].shape)
    return out, target


def check_size(camera: Camera, image: NDArray[np.generic]) -> None:
    """Raise CameraError unless the image (height, width, ...) has the size of the camera's photographs."""
    height, width = image.shape[:2] if image.ndim >= 2 else (0, 0)
    if (width, height) == (camera.width_px, camera.height_px):
        return
    hint = "use the camera file that was made with photographs of this size"
    if (height, width) == (camera.width_px, camera.height_px):
        hint = "one of them is turned by a quarter; use pixels as the camera stored them (a turn that EXIF asks for is not made)"
    raise CameraError(f"the photograph has {width}x{height} px but the camera {camera.width_px}x{camera.height_px}: {hint}")
