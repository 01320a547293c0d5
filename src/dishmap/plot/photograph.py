"""The photograph with what was found drawn over it, and the map of expected projection error (the paper's Fig. 1), as SVG.

The picture is 1600 units wide or 1200 high, whichever is reached first, whatever the photograph's size, so lines and letters keep theirs.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from dishmap.camera.uncertainty import ProjectionError
from dishmap.plot.canvas import BLUE, FAINT, INK, ORANGE, RED, Array, color_norm, hex_colors, round_length

BOX = (1600.0, 1200.0)
JPEG_QUALITY = 76
# A photograph in the background needs less.
BACKGROUND_QUALITY, BACKGROUND_PART = 70, 0.5
LEGEND_HEIGHT = 92.0
# What is shown about the pattern, as a part of its size.
CROP_MARGIN = 0.12
# Letters between these sizes; where targets stand too close for the smaller, ids show on hovering only.
SMALLEST_TEXT, LARGEST_TEXT = 8.0, 24.0
# Width of a digit over its height, and the part of a target's spacing that its id may take.
DIGIT_WIDTH, TEXT_PART = 0.6, 0.4
# Lines are thinner where the next target is nearer than this, but not below that part.
ROOMY, THINNEST = 45.0, 0.35
WHITE_PERCENTILE = 99.5
# The largest circle of expected error takes this part of the spacing of the grid.
CIRCLE_PART = 0.48
# ... and stands for at most so many times the median error.
LARGEST_TIMES_MEDIAN = 4.0


@dataclass(frozen=True)
class Outline:
    """One target as it is drawn, in pixels of the photograph.

    ellipses_px (K, 3, 2): each as its centre and the ends of two conjugate radii; strokes_px: lines, each (P, 2); label: the text at
    `label_px`; title: what hovering tells; sigma: for the colour, NaN when unknown; state: `good`, `rejected`, `missing` or `unused`
    (looks like a mark, is none).
    """

    ellipses_px: Array
    label_px: Array
    label: str
    title: str
    sigma: float
    state: str
    strokes_px: tuple[Array, ...] = ()

    @property
    def points_px(self) -> Array:
        """All points (P, 2) that are drawn."""
        return np.concatenate([self.ellipses_px.reshape(-1, 2), *self.strokes_px])


@dataclass(frozen=True)
class Frame:
    """The part of a photograph that is shown, and its size in the SVG: units per pixel, first and past-the-last columns and rows."""

    scale: float
    columns: tuple[int, int]
    rows: tuple[int, int]

    @property
    def width(self) -> float:
        """Width in units."""
        return self.scale * (self.columns[1] - self.columns[0])

    @property
    def height(self) -> float:
        """Height in units."""
        return self.scale * (self.rows[1] - self.rows[0])

    def place(self, pixels: Array) -> Array:
        """Units of pixels (..., 2); the outer corner of the first pixel shown is (0, 0)."""
        return np.asarray((pixels - [self.columns[0], self.rows[0]] + 0.5) * self.scale)


def frame_of(width_px: int, height_px: int, around_px: Array | None = None) -> Frame:
    """The frame of a photograph of this size: all of it, or what lies about points (K, 2)."""
    low, high = np.zeros(2, dtype=int), np.array([width_px, height_px])
    if around_px is not None and len(around_px):
        margin = CROP_MARGIN * np.ptp(around_px, axis=0).max()
        low = np.maximum(np.floor(around_px.min(axis=0) - margin).astype(int), 0)
        high = np.minimum(np.ceil(around_px.max(axis=0) + margin).astype(int) + 1, high)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    return Frame(min(BOX[0] / (right - left), BOX[1] / (bottom - top)), (left, right), (top, bottom))


def photograph_frame(image: NDArray[np.generic], outlines: list[Outline]) -> Frame:
    """The part of a photograph (H, W) that holds the pattern's targets, with a margin."""
    points = [o.points_px for o in outlines if o.state != "unused"]
    return frame_of(image.shape[1], image.shape[0], np.concatenate(points) if points else None)


def photograph_svg(image: NDArray[np.generic], frame: Frame, outlines: list[Outline], sigma_label: str, alt: str) -> str:
    """The framed part of the photograph (H, W) with outlined targets; colours by sigma where known, with their scale below."""
    sigma = np.array([o.sigma for o in outlines if o.state == "good"])
    known = sigma[np.isfinite(sigma)]
    norm = color_norm(known)
    text, thickness = _text_size(frame, outlines), _thickness(frame, outlines)
    body = [picture(image, frame, JPEG_QUALITY)]
    for outline in outlines:
        color = hex_colors([outline.sigma], norm)[0] if np.isfinite(outline.sigma) else BLUE
        body.append(_outline(frame, outline, color, text, thickness))
    legend = _legend(frame, norm, sigma_label) if known.size else ""
    # an SVG of its own cuts outlines off at the picture's border
    clipped = f'<svg width="{frame.width:.1f}" height="{frame.height:.1f}">{"".join(body)}</svg>'
    return _svg(frame, 0.0, LEGEND_HEIGHT if known.size else 0.0, alt, [clipped, legend])


def error_svg(error: ProjectionError, width_px: int, height_px: int, alt: str, image: NDArray[np.generic] | None = None) -> str:
    """Circles whose radius is the expected projection error, over the faded photograph if one is given."""
    frame = frame_of(width_px, height_px)
    sigma, at = error.sigma_px.ravel(), frame.place(error.pixels.reshape(-1, 2))
    spacing = min(frame.height / error.pixels.shape[0], frame.width / error.pixels.shape[1])
    # corners where the lens is extrapolated must not shrink all other circles to dots
    largest = min(float(np.nanmax(sigma)), LARGEST_TIMES_MEDIAN * float(np.nanmedian(sigma)))
    units_per_px = CIRCLE_PART * spacing / largest if largest > 0 else 1.0
    back = f'<rect width="{frame.width:.1f}" height="{frame.height:.1f}" fill="#ffffff" stroke="{FAINT}"/>'
    if image is not None:
        back += f'<g opacity="0.45">{picture(image, frame, BACKGROUND_QUALITY, BACKGROUND_PART)}</g>'
    known = np.isfinite(sigma)
    circles = "".join(
        _error_circle(x, y, s, min(s, largest) * units_per_px, s > largest)
        for (x, y), s in zip(at[known].tolist(), sigma[known].tolist(), strict=True)
    )
    marks = f'<g fill="none" stroke="#ffffff" stroke-width="5" opacity="0.7">{circles}</g>' if image is not None else ""
    marks += f'<g fill="{BLUE}" fill-opacity="0.15" stroke="{BLUE}" stroke-width="2.2">{circles}</g>'
    key, margin = round_length(largest) if largest > 0 else 0.0, CIRCLE_PART * spacing
    radius, middle = key * units_per_px, frame.height + margin + LEGEND_HEIGHT / 2
    meaning = f"this radius is an expected error of {key:g} px"
    legend = (
        f'<circle cx="{radius:.1f}" cy="{middle:.1f}" r="{radius:.1f}" fill="none" stroke="{BLUE}" stroke-width="2.2"/>'
        f'<text x="{2 * radius + 14:.1f}" y="{middle + 8:.1f}" font-size="24" fill="{INK}">{meaning}</text>'
    )
    return _svg(frame, margin, LEGEND_HEIGHT, alt, [back, marks, legend])


def _error_circle(x: float, y: float, sigma_px: float, radius: float, cut: bool) -> str:
    """One circle of expected error; orange and dashed where it is drawn smaller than it is."""
    style = f' stroke="{ORANGE}" stroke-dasharray="8 6"' if cut else ""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{max(radius, 0.5):.1f}"{style}><title>{sigma_px:.3g} px</title></circle>'


def _svg(frame: Frame, around: float, below: float, alt: str, body: list[str]) -> str:
    """The SVG element with a margin around the picture and room below it, in units."""
    view = f"{-around:.1f} {-around:.1f} {frame.width + 2 * around:.1f} {frame.height + 2 * around + below:.1f}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="picture" role="img" aria-label="{escape(alt)}" viewBox="{view}" '
        f'style="width:{100 * frame.width / BOX[0]:.1f}%" font-family="sans-serif">{"".join(body)}</svg>'
    )


def picture(image: NDArray[np.generic], frame: Frame, quality: int, part: float = 1.0) -> str:
    """The framed part of the photograph, embedded as JPEG with up to `part` pixels a unit, never enlarged."""
    gray = np.asarray(image)[slice(*frame.rows), slice(*frame.columns)]
    if frame.scale * part < 1:
        size = (max(1, round(frame.width * part)), max(1, round(frame.height * part)))
        gray = cv2.resize(gray if gray.dtype in (np.uint8, np.uint16) else gray.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if gray.dtype != np.uint8:
        white = float(np.percentile(gray, WHITE_PERCENTILE)) or 1.0
        gray = np.clip(gray.astype(np.float32) * (255.0 / white), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, quality])
    link = "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
    return f'<image width="{frame.width:.1f}" height="{frame.height:.1f}" preserveAspectRatio="none" href="{link}"/>'


def shows_ids(frame: Frame, outlines: list[Outline]) -> bool:
    """Whether there is room to write the ids of targets, and not on hovering alone."""
    return _text_size(frame, outlines) > 0


def _text_size(frame: Frame, outlines: list[Outline]) -> float:
    """Size of letters at which neighbouring ids do not touch; 0 where that is too small to read."""
    named = [o for o in outlines if o.label]
    if not named:
        return 0.0
    digits = max(len(o.label) for o in named)
    spacing = _spacing(frame, outlines)
    spacing = spacing if np.isfinite(spacing) else LARGEST_TEXT * digits
    size = TEXT_PART * spacing / (DIGIT_WIDTH * max(digits, 2))
    return 0.0 if size < SMALLEST_TEXT else min(size, LARGEST_TEXT)


def _spacing(frame: Frame, outlines: list[Outline]) -> float:
    """Distance in units to the next target, of nearly all of them; infinite for one alone."""
    at = np.array([o.label_px for o in outlines if o.label])
    if len(at) < 2:
        return float("inf")
    from scipy.spatial import cKDTree

    return float(np.quantile(cKDTree(frame.place(at)).query(frame.place(at), k=2)[0][:, 1], 0.02))


def _thickness(frame: Frame, outlines: list[Outline]) -> float:
    """Of lines, relative to the usual one: thinner where targets stand close."""
    return float(np.clip(_spacing(frame, outlines) / ROOMY, THINNEST, 1.0))


def _outline(frame: Frame, outline: Outline, color: str, text: float, thickness: float) -> str:
    color = {"good": color, "rejected": "#e31a1c", "missing": "#ffffff", "unused": "#e31a1c"}[outline.state]
    dash = {"good": "", "unused": ' stroke-dasharray="2 3"'}.get(outline.state, ' stroke-dasharray="7 4"')
    rings = []
    for ellipse in frame.place(outline.ellipses_px).tolist():
        (x, y), (ax, ay), (bx, by) = ellipse
        matrix = f"matrix({ax - x:.2f} {ay - y:.2f} {bx - x:.2f} {by - y:.2f} {x:.1f} {y:.1f})"
        rings.append(f'<circle r="1" transform="{matrix}" vector-effect="non-scaling-stroke"/>')
    if outline.strokes_px:
        paths = (frame.place(stroke).tolist() for stroke in outline.strokes_px)
        rings.append(f'<path d="{"".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in path) for path in paths)}"/>')
    shapes = "".join(rings)
    # a dark line under the coloured one keeps it visible on ink and on ground; strokes lie on ink, which is dark itself
    under = "#ffffff" if outline.strokes_px and outline.state != "missing" else "#000000"
    lines = f'<g fill="none" stroke="{under}" stroke-width="{3.6 * thickness:.2g}">{shapes}</g>'
    lines += f'<g fill="none" stroke="{color}" stroke-width="{2.2 * thickness:.2g}"{dash}>{shapes}</g>'
    (x, y), name = frame.place(outline.label_px).tolist(), ""
    if outline.state == "rejected":
        arm = 9 * thickness
        cross = f"M{x - arm:.1f} {y - arm:.1f}l{2 * arm:.1f} {2 * arm:.1f}m0 {-2 * arm:.1f}l{-2 * arm:.1f} {2 * arm:.1f}"
        lines += f'<path d="{cross}" stroke="#e31a1c" stroke-width="{3.5 * thickness:.2g}"/>'
        text, y = max(text, 16.0), y - 12 - 0.4 * max(text, 16.0)
    if outline.label and text:
        fill = RED if outline.state == "rejected" else INK
        name = (
            f'<text x="{x:.1f}" y="{y + 0.36 * text:.1f}" font-size="{text:.1f}" text-anchor="middle" fill="{fill}" '
            f'stroke="#ffffff" stroke-width="{0.2 * text:.1f}" stroke-linejoin="round" paint-order="stroke">{escape(outline.label)}</text>'
        )
    return f"<g><title>{escape(outline.title)}</title>{lines}{name}</g>"


def _legend(frame: Frame, norm: Normalize, label: str) -> str:
    """A strip of colours with its values under it and what they are beside it."""
    left, width, top, steps = 60.0, min(520.0, 0.4 * frame.width), frame.height + 16, 52
    colors = hex_colors(norm.inverse((np.arange(steps) + 0.5) / steps), norm)
    size = f'y="{top:.1f}" width="{width / steps + 0.5:.1f}" height="20" shape-rendering="crispEdges"'
    parts = [f'<rect x="{i * width / steps + left:.1f}" {size} fill="{color}"/>' for i, color in enumerate(colors)]
    for part in (0.0, 0.5, 1.0):
        x, value = left + part * width, float(norm.inverse(part))
        parts.append(f'<text x="{x:.1f}" y="{top + 48:.1f}" font-size="24" text-anchor="middle" fill="{INK}">{value:.3g}</text>')
    parts.append(f'<text x="{left + width + 40:.1f}" y="{top + 19:.1f}" font-size="24" fill="{INK}">{escape(label)}</text>')
    return "".join(parts)
