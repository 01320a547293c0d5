"""How targets moved in the picture: enlarged arrows over the photograph, as SVG in the units of `plot.photograph`."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.plot.canvas import FAINT, INK, ORANGE, Array, round_length
from dishmap.plot.photograph import BOX, JPEG_QUALITY, Frame, frame_of, picture

# The arrow of this quantile takes this part of the way to the next target, or of the frame's larger side where that is less; longer
# ones are cut at so many times that.
ARROW_QUANTILE, SPACING_PART, ARROW_PART, LONGEST_SHOWN = 0.95, 0.8, 0.075, 1.6
# Yellow stands out from ink and ground alike once it has a dark edge, orange-red tells what is cut; both for the colour-blind too.
PLAIN, CUT = "#f0e442", ORANGE
WIDTH, CASING, HEAD = 3.4, 6.6, 11.0
# Where targets stand closer than this, arrows are drawn of some only: of each cell so wide the longest.
LEAST_SPACING = 44.0
# Shorter arrows are drawn as their dot alone.
SHORTEST = 2.0
LEGEND_HEIGHT = 70.0


@dataclass(frozen=True)
class Arrows:
    """Arrows of N targets, and how they are drawn.

    from_px (N, 2): where targets were; move_px (N, 2); titles: what hovering tells; factor: by how much moves are enlarged; usual: length
    in units of the frame that most arrows stay below; of: how many targets these were chosen from.
    """

    from_px: Array
    move_px: Array
    titles: tuple[str, ...]
    factor: float
    usual: float
    frame: Frame
    of: int

    @property
    def cut(self) -> NDArray[np.bool_]:
        """Arrows (N,) that are drawn shorter than their factor says."""
        return np.asarray(self.factor * self.frame.scale * np.hypot(*self.move_px.T) > LONGEST_SHOWN * self.usual)


def arrows_of(size_px: tuple[int, int], from_px: Array, move_px: Array, titles: tuple[str, ...]) -> Arrows:
    """Arrows enlarged by a round factor, 1 or more, on the part of a photograph (width, height) that holds them; of some of many."""
    near = cKDTree(from_px).query(from_px, k=2)[0][:, 1] if len(from_px) > 1 else np.zeros(1)
    spacing = float(np.median(near)) or float(max(size_px))
    # half the way to the next target is about what one takes up
    frame = frame_of(*size_px, np.concatenate([from_px - spacing / 2, from_px + spacing / 2]))
    shown = _apart(frame, from_px, move_px) if spacing * frame.scale < LEAST_SPACING else np.arange(len(from_px))
    spacing = max(spacing, min(LEAST_SPACING / frame.scale, max(size_px)))
    usual = min(SPACING_PART * spacing * frame.scale, ARROW_PART * max(BOX))
    typical = float(np.quantile(np.hypot(*move_px.T), ARROW_QUANTILE)) * frame.scale
    factor = max(1.0, round_length(usual / typical)) if typical > 0 else 1.0
    return Arrows(from_px[shown], move_px[shown], tuple(titles[i] for i in shown), factor, usual, frame, len(from_px))


def _apart(frame: Frame, from_px: Array, move_px: Array) -> NDArray[np.int64]:
    """Of targets in each cell of the frame the one with the longest arrow."""
    order = np.argsort(-np.hypot(*move_px.T), kind="stable")
    _, first = np.unique(np.floor(frame.place(from_px[order]) / LEAST_SPACING).astype(np.int64), axis=0, return_index=True)
    return np.sort(order[first])


def arrows_svg(image: NDArray[np.generic] | None, arrows: Arrows, alt: str) -> str:
    """The arrows over the photograph (H, W), or over white where there is none, with a scale below."""
    frame, cut = arrows.frame, arrows.cut
    start = frame.place(arrows.from_px)
    step = arrows.factor * frame.scale * arrows.move_px
    longest = LONGEST_SHOWN * arrows.usual
    step = np.where(cut[:, None], step * (longest / np.maximum(np.hypot(*step.T), longest))[:, None], step)
    body = [_backdrop(image, frame)]
    body += [_arrow(s, d, title, CUT if c else PLAIN) for s, d, title, c in zip(start, step, arrows.titles, cut, strict=True)]
    body.append(_legend(arrows))
    view = f"0 0 {frame.width:.1f} {frame.height + LEGEND_HEIGHT:.1f}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="picture" role="img" aria-label="{escape(alt)}" viewBox="{view}" '
        f'style="width:{100 * frame.width / BOX[0]:.1f}%" font-family="sans-serif">{"".join(body)}</svg>'
    )


def _backdrop(image: NDArray[np.generic] | None, frame: Frame) -> str:
    if image is None:
        return f'<rect width="{frame.width:.1f}" height="{frame.height:.1f}" fill="#ffffff" stroke="{FAINT}"/>'
    return picture(image, frame, JPEG_QUALITY)


def _arrow(start: Array, step: Array, title: str, color: str) -> str:
    """A dot where the target was and an arrow to where it went, light on a dark edge."""
    edge = f'stroke="{INK}" stroke-width="1.6"'
    (x, y), length = start.tolist(), float(np.hypot(*step))
    shape = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.6" fill="{color}" {edge}/>'
    if length > SHORTEST:
        along = step / length
        head = min(HEAD, length)
        tip, neck, side = start + step, start + step - head * along, 0.45 * head * np.array([-along[1], along[0]])
        line = f'<path d="M{_at(start)}L{_at(neck)}" '
        shape += f'{line}stroke="{INK}" stroke-width="{CASING}"/>'
        shape += f'<path d="M{_at(tip)}L{_at(neck + side)}L{_at(neck - side)}z" fill="{color}" {edge}/>'
        shape += f'{line}stroke="{color}" stroke-width="{WIDTH}"/>'
    return f"<g><title>{escape(title)}</title>{shape}</g>"


def _at(point: Array) -> str:
    return f"{point[0]:.1f} {point[1]:.1f}"


def _legend(arrows: Arrows) -> str:
    """An arrow of a round length with its meaning, below the picture."""
    frame, middle = arrows.frame, arrows.frame.height + LEGEND_HEIGHT / 2
    per_px = arrows.factor * frame.scale
    longest = float(np.hypot(*arrows.move_px.T).max())
    if longest == 0:
        return f'<text x="10" y="{middle + 8:.1f}" font-size="24" fill="{INK}">no target moved in the picture</text>'
    key = round_length(arrows.usual / per_px)
    shape = _arrow(np.array([10.0, middle]), np.array([key * per_px, 0.0]), "", PLAIN)
    words = f"{key:g} px in the picture" + (f", drawn {arrows.factor:g} times enlarged" if arrows.factor > 1 else "")
    words += "; orange: cut, longer than drawn" if arrows.cut.any() else ""
    return f'{shape}<text x="{key * per_px + 34:.1f}" y="{middle + 8:.1f}" font-size="24" fill="{INK}">{words}</text>'
