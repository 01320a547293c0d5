"""Charts of what was measured, over the dish as seen from its focus: x to the right, y up, millimetres."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from dishmap.plot.canvas import BLUE, DIVERGING, FAINT, INK, ORANGE, RED, SEQUENTIAL, Array, as_svg, color_norm, new_figure, round_length

MAP_WIDTH_IN, MAP_BODY_IN, MAP_HEIGHTS_IN = 6.2, 4.6, (1.2, 6.0)
CHART_IN = (6.2, 4.4)
POINTS_PER_INCH = 72.0
LEVELS = 20
# Free room around the points, as a share of their span.
MARGIN = 0.08
# Names beside points stay readable up to so many.
MOST_NAMES = 12
# An arrow of the longest kind takes this part of the map's width; strays beyond this quantile may be longer,
LONGEST_ARROW, ARROW_QUANTILE = 0.12, 0.95
# ... but are cut at so many times that length.
LONGEST_SHOWN = 1.6
# Marks are as large as asked where the next target is at least so far away, in points of the page; nearer ones make them smaller.
ROOMY_PT, SMALLEST_PART = 16.0, 0.08
# Arrows of normals reach at most so many times the way to the next target.
ARROW_SPACINGS = 1.6
# Beyond this factor the spread found is drawn beside the one claimed.
SPREAD_WORTH_DRAWING = 1.5
# Bins of a histogram hold on average so many points, within limits.
POINTS_PER_BIN, FEWEST_BINS, MOST_BINS = 6, 8, 40


@as_svg
def residual_map(xy_mm: Array, residual_mm: Array, off: NDArray[np.bool_], ids: NDArray[np.int64], label: str) -> Figure:
    """Residuals (N,) to the surface at points (N, 2), on a scale that is symmetric about zero; points off the surface as crosses."""
    figure, axes = map_figure(xy_mm)
    on = ~off
    largest = float(np.abs(residual_mm[on]).max()) if on.any() else 0.0
    largest = largest or float(np.abs(residual_mm).max()) or 1.0
    norm = Normalize(-largest, largest)
    fill_map(axes, xy_mm[on], residual_mm[on], norm, DIVERGING)
    dots = axes.scatter(xy_mm[on, 0], xy_mm[on, 1], c=residual_mm[on], cmap=DIVERGING, norm=norm, zorder=3, **marks(xy_mm, 26))
    if off.any():
        axes.scatter(xy_mm[off, 0], xy_mm[off, 1], marker="X", c=ORANGE, zorder=4, label="off the surface", **marks(xy_mm, 60))
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0)
        if off.sum() <= MOST_NAMES:
            _name(axes, xy_mm[off], ids[off])
    figure.colorbar(dots, ax=axes, label=label)
    dish_axes(axes, xy_mm)
    return figure


@as_svg
def sigma_map(xy_mm: Array, sigma: Array, label: str) -> Figure:
    """Sigmas (N,) at points (N, 2), filled between them."""
    figure, axes = map_figure(xy_mm)
    norm = color_norm(sigma)
    fill_map(axes, xy_mm, sigma, norm, SEQUENTIAL)
    dots = axes.scatter(xy_mm[:, 0], xy_mm[:, 1], c=sigma, cmap=SEQUENTIAL, norm=norm, zorder=3, **marks(xy_mm, 26))
    bar = figure.colorbar(dots, ax=axes, label=label)
    if isinstance(norm, LogNorm):
        plain_ticks(bar, norm)
    dish_axes(axes, xy_mm)
    return figure


@as_svg
def normals_map(xy_mm: Array, lean_rad: Array, reference: str) -> Figure:
    """Arrows at points (N, 2) showing how far, and to which side, normals lean from a reference: lean_rad (N, 2)."""
    figure, axes = map_figure(xy_mm)
    lean_deg = np.degrees(lean_rad)
    length_deg = np.hypot(*lean_deg.T)
    typical = float(np.quantile(length_deg, ARROW_QUANTILE)) or float(length_deg.max()) or 1.0
    long = length_deg > LONGEST_SHOWN * typical
    shown = np.where(long[:, None], lean_deg * (LONGEST_SHOWN * typical / np.maximum(length_deg, typical))[:, None], lean_deg)
    axes.scatter(xy_mm[:, 0], xy_mm[:, 1], s=7 * _room(xy_mm), c=FAINT, zorder=2)
    longest = min(LONGEST_ARROW, ARROW_SPACINGS * _spacing_part(xy_mm))
    style: dict[str, Any] = {
        "angles": "uv",
        "scale_units": "width",
        "scale": typical / longest,
        "width": 0.004 * longest / LONGEST_ARROW,
        "headwidth": 4,
        "headlength": 4.5,
        "zorder": 3,
        "clip_on": False,
    }
    arrows = axes.quiver(*xy_mm.T, *shown.T, color=np.where(long, ORANGE, BLUE).tolist(), **style)
    arrows.set_in_layout(False)
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)
    engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.4 / figure.get_figheight()))  # room for the key
    top = 1.0 - 0.2 / figure.get_figheight()
    key = round_length(typical)
    axes.quiverkey(arrows, 0.16, top, key, f"{key:g}° from the {reference}", labelpos="E", coordinates="figure", color=BLUE)
    if long.any():
        figure.text(0.97, top, "longer", color=ORANGE, ha="right", va="center")
    dish_axes(axes, xy_mm)
    return figure


@as_svg
def ratio_histogram(ratio: Array, spread: float) -> Figure:
    """Histogram of residual over claimed sigma (N,) with the normal curve that true sigmas would give.

    spread: the robust spread of the ratio; where it is far from one, the normal curve of that spread is drawn too.
    """
    figure, axes = new_figure(*CHART_IN)
    reach = max(4.0, 1.15 * float(np.abs(ratio).max()))
    if spread > 0:
        reach = min(reach, max(4.0, 6.0 * spread))
    bins = int(np.clip(len(ratio) / POINTS_PER_BIN * reach / max(4.0, 3.0 * spread), FEWEST_BINS, MOST_BINS))
    inside = np.clip(ratio, -reach, reach)
    density, *_ = axes.hist(inside, bins=bins, range=(-reach, reach), density=True, color="#a6cee3", edgecolor="#4d7ea8", linewidth=0.6)
    x = np.linspace(-reach, reach, 801)
    axes.plot(x, _normal_curve(x, 1.0), color=INK, label="if the claimed sigmas are all there is")
    highest = float(np.max(density))
    if spread > SPREAD_WORTH_DRAWING:
        axes.plot(x, _normal_curve(x, spread), color=ORANGE, linestyle="--", label=f"{spread:.3g} times wider")
        highest = max(highest, float(_normal_curve(np.zeros(1), spread)[0]))
    else:
        highest = max(highest, 0.4)
    axes.set(xlabel="residual / claimed sigma", ylabel="share of targets per unit", xlim=(-reach, reach), ylim=(0.0, 1.08 * highest))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0)
    return figure


def _normal_curve(x: Array, spread: float) -> Array:
    return np.asarray(np.exp(-0.5 * (x / spread) ** 2) / (spread * np.sqrt(2 * np.pi)))


def marks(xy_mm: Array, area_pt2: float) -> dict[str, Any]:
    """Size and edges of marks at points (N, 2): `area_pt2` where there is room, smaller where the next one is near."""
    room = _room(xy_mm)
    return {"s": area_pt2 * room, "edgecolors": INK, "linewidths": 0.6 * np.sqrt(room)}


def _room(xy_mm: Array) -> float:
    """Area that a mark may take, as a part of the usual one."""
    return float(np.clip((_spacing_part(xy_mm) * MAP_BODY_IN * POINTS_PER_INCH / ROOMY_PT) ** 2, SMALLEST_PART, 1.0))


def _spacing_part(xy_mm: Array) -> float:
    """Usual distance to the next point, as a part of the points' span; 1 for one alone."""
    if len(xy_mm) < 2:
        return 1.0
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(xy_mm).query(xy_mm, k=2)[0][:, 1])) / _span(xy_mm) or 1.0


def map_figure(xy_mm: Array, body_in: float = MAP_BODY_IN) -> tuple[Figure, Axes]:
    """A figure of the height that the points' outline needs, `body_in` for a square one."""
    along, across = np.ptp(xy_mm, axis=0) + 2 * MARGIN * _span(xy_mm)
    return new_figure(MAP_WIDTH_IN, float(np.clip(body_in * across / along, *MAP_HEIGHTS_IN)) + 0.9, "compressed")


def plain_ticks(bar: Colorbar, norm: LogNorm) -> None:
    """Plain numbers instead of powers of ten beside logarithmic colours."""
    bar.set_ticks(ticks := _ticks(float(norm.vmin or 0), float(norm.vmax or 0)), labels=[f"{tick:g}" for tick in ticks], minor=False)
    bar.minorticks_off()


def _ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 times powers of ten within [low, high]; the ends where there are none."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    return [t for p in powers for step in (1, 2, 5) if low <= (t := float(f"{step}e{p}")) <= high] or [low, high]


def _span(xy_mm: Array) -> float:
    return float(np.ptp(xy_mm, axis=0).max()) or 1.0


def fill_map(axes: Axes, xy_mm: Array, values: Array, norm: Normalize, colors: str) -> None:
    """Filled contours, linear between neighbouring points; nothing where the points span no area."""
    triangles = _triangulation(xy_mm)
    if triangles is None or not np.ptp(values) > 0:
        return
    levels = norm.inverse(np.linspace(0.0, 1.0, LEVELS + 1))
    # rounding must not leave the extreme points outside the outermost levels
    levels[0], levels[-1] = min(levels[0], values.min()), max(levels[-1], values.max())
    filled = axes.tricontourf(triangles, values, levels=levels, cmap=colors, norm=norm, alpha=0.85, zorder=1)
    filled.set_edgecolor("face")


def _triangulation(xy_mm: Array) -> Triangulation | None:
    """Delaunay triangles without the needles along the rim; None where points lie on one line or are too few."""
    if len(xy_mm) < 3 or np.linalg.matrix_rank(xy_mm - xy_mm.mean(axis=0), tol=1e-6 * _span(xy_mm)) < 2:
        return None
    return Triangulation(*xy_mm.T)


def _name(axes: Axes, xy_mm: Array, ids: NDArray[np.int64]) -> None:
    for (x, y), ident in zip(xy_mm, ids, strict=True):
        axes.annotate(str(ident), (x, y), xytext=(6, 6), textcoords="offset points", color=RED, fontsize=10, zorder=5)


def dish_axes(axes: Axes, xy_mm: Array) -> None:
    """Equal scales, a margin around the points, and units."""
    low, high = xy_mm.min(axis=0), xy_mm.max(axis=0)
    margin = MARGIN * _span(xy_mm)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="box")
