"""Charts of a camera's calibration: how well each view fits, where the board was seen, what is left, and what the lens does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.plot.canvas import BLUE, FAINT, INK, ORANGE, SEQUENTIAL, Array, as_svg, new_figure, round_length

WIDTH_IN, BAR_IN, AXES_IN = 6.2, 0.24, 0.9
# Beyond so many views only their numbers are written, and names are cut at so many letters.
MOST_NAMED, MOST_LETTERS = 60, 24
# The scale of colours ends here, so that a few outliers do not wash out the rest.
LARGEST_QUANTILE = 0.99
# A typical residual is drawn as long as this part of the picture.
LINE_PART = 0.012
# Maps of errors go up to this many times the largest value where corners were seen.
FIELD_HEADROOM = 4.0
# Points a side of the map of the lens; rays more oblique than this cosine have no place in a flat picture.
GRID_POINTS, MOST_OBLIQUE = 41, 0.1


@as_svg
def view_bars(names: Sequence[str], view_rms_px: Array, rms_px: float) -> Figure:
    """A bar for each view's rms residual (V,), with that of all as a line."""
    named = len(names) <= MOST_NAMED
    figure, axes = new_figure(WIDTH_IN, AXES_IN + BAR_IN * min(max(len(names), 3), MOST_NAMED))
    place = np.arange(len(names))
    axes.barh(place, view_rms_px, color=BLUE, height=0.7)
    axes.axvline(rms_px, color=ORANGE, linestyle="--", label=f"all views: {rms_px:.3g} px")
    if named:
        # a dollar sign would start a formula
        axes.set_yticks(place, [_short(name).replace("$", r"\$") for name in names], fontsize=9)
    else:
        axes.set_ylabel("view, in the order given")
    axes.invert_yaxis()
    axes.set_xlabel("rms residual (px)")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0)
    return figure


@as_svg
def coverage_map(pixels: Array, residual_px: Array, used: NDArray[np.bool_], width_px: int, height_px: int) -> Figure:
    """Corners (N, 2) of all views over the picture, coloured by the length of their residuals (N, 2); unused ones as crosses."""
    figure, axes = _picture_axes(width_px, height_px)
    length = np.hypot(residual_px[used, 0], residual_px[used, 1])
    top = float(np.quantile(length, LARGEST_QUANTILE)) or 1.0
    dots = axes.scatter(pixels[used, 0], pixels[used, 1], c=length, s=5, cmap=SEQUENTIAL, vmin=0.0, vmax=top, linewidths=0, rasterized=True)
    if not used.all():
        axes.scatter(pixels[~used, 0], pixels[~used, 1], marker="x", s=26, c=ORANGE, label="left out")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0)
    figure.colorbar(dots, ax=axes, label="residual (px)", extend="max")
    axes.set_title("corners seen in all views", fontsize=10, loc="right")
    return _framed(figure, axes, width_px, height_px)


@as_svg
def residual_vectors(pixels: Array, residual_px: Array, used: NDArray[np.bool_], width_px: int, height_px: int) -> Figure:
    """Residuals (N, 2) of used corners as lines from the corners (N, 2), enlarged by a round factor that is written beside them."""
    figure, axes = _picture_axes(width_px, height_px)
    at, vector = pixels[used], residual_px[used]
    typical = float(np.sqrt((vector**2).sum(axis=1).mean())) or 1.0
    factor = max(1.0, round_length(LINE_PART * max(width_px, height_px) / typical))
    ends = at + factor * vector
    lines = np.stack([at, ends], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=BLUE, linewidths=0.5, rasterized=True))
    axes.scatter(at[:, 0], at[:, 1], s=1.0, c=INK, linewidths=0, rasterized=True)
    axes.set_title(f"residuals {factor:g} times enlarged", fontsize=10)
    return _framed(figure, axes, width_px, height_px)


@as_svg
def field_maps(
    pixels: Array, fields: Sequence[tuple[str, Array]], covered: NDArray[np.bool_], label: str, seen_px: Array | None = None
) -> Figure:
    """Maps (R, C) of positive values over the picture on one scale of colours; what corners do not cover is hatched.

    pixels (R, C, 2); fields: title and values; covered (R, C); seen_px (N, 2): corners, drawn as dots.
    """
    width_px, height_px = int(pixels[-1, -1, 0] + 0.5), int(pixels[-1, -1, 1] + 0.5)
    # two maps side by side are smaller
    grow = 1.0 if len(fields) == 1 else 1.3
    figure = Figure(figsize=(WIDTH_IN * grow, AXES_IN + _height_in(width_px, height_px) / grow), layout="compressed")
    inside = np.concatenate([values[covered] for _, values in fields])
    inside = inside[np.isfinite(inside) & (inside > 0)]
    # what is extrapolated must not wash out what is known
    high = float(inside.max()) * FIELD_HEADROOM if inside.size else 1.0
    low = min(float(inside.min()) if inside.size else 0.1, high / 2)
    norm = LogNorm(low, high)
    levels = np.geomspace(low, high, 25)
    for axes, (title, values) in zip(figure.subplots(1, len(fields), squeeze=False)[0], fields, strict=True):
        shown = np.ma.masked_invalid(np.clip(values, low, None))
        drawn = axes.contourf(pixels[..., 0], pixels[..., 1], shown, levels=levels, norm=norm, cmap=SEQUENTIAL, extend="max")
        axes.contourf(pixels[..., 0], pixels[..., 1], covered.astype(float), levels=[-0.5, 0.5], colors="none", hatches=["///"])
        axes.contour(pixels[..., 0], pixels[..., 1], covered.astype(float), levels=[0.5], colors=ORANGE, linewidths=1.5)
        if seen_px is not None:
            axes.scatter(seen_px[:, 0], seen_px[:, 1], s=0.5, c="white", alpha=0.5, linewidths=0, rasterized=True)
        axes.set_title(title, fontsize=10)
        _framed(figure, axes, width_px, height_px)
    bar = figure.colorbar(drawn, ax=figure.axes, label=label, ticks=_round_ticks(low, high))
    bar.ax.minorticks_off()
    bar.ax.set_yticklabels([f"{tick:g}" for tick in _round_ticks(low, high)])
    return figure


@as_svg
def distortion_map(camera: Camera) -> Figure:
    """How far the lens moves what a pinhole camera would see: a straight grid as it is seen, coloured by the shift in px."""
    figure, axes = _picture_axes(camera.width_px, camera.height_px)
    u, v = np.linspace(-0.5, camera.width_px - 0.5, GRID_POINTS), np.linspace(-0.5, camera.height_px - 0.5, GRID_POINTS)
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays = camera.unproject(pixels)
    with np.errstate(invalid="ignore", divide="ignore"):
        straight = rays[..., :2] / np.where(rays[..., 2:] > MOST_OBLIQUE, rays[..., 2:], np.nan) * camera.focal_px + camera.principal_px
    shift = np.linalg.norm(pixels - straight, axis=-1)
    shown = np.ma.masked_invalid(shift)
    if shown.count() > GRID_POINTS and float(shown.max() - shown.min()) > 0:
        drawn = axes.contourf(u, v, shown, levels=20, cmap=SEQUENTIAL)
        figure.colorbar(drawn, ax=axes, label="shift by the lens (px)")
    inside = np.isfinite(straight).all(axis=-1)
    for part in (0.2, 0.4, 0.6, 0.8, 1.0):
        reach = part * float(np.linalg.norm(straight[inside] - camera.principal_px, axis=-1).max()) if inside.any() else 0.0
        ring = _straight_circle(camera, reach)
        axes.plot(ring[:, 0], ring[:, 1], color="white", linewidth=0.9)
    axes.plot(*camera.principal_px, marker="+", color=ORANGE, markersize=12)
    axes.set_title("distortion of the lens", fontsize=10)
    return _framed(figure, axes, camera.width_px, camera.height_px)


def _straight_circle(camera: Camera, radius_px: float) -> Array:
    """The image (N, 2) of a circle that a pinhole camera would see with this radius about the principal point."""
    phi = np.linspace(0, 2 * np.pi, 181)
    plane = radius_px * np.stack([np.cos(phi), np.sin(phi)], axis=-1) / camera.focal_px
    return camera.project(np.concatenate([plane, np.ones((len(phi), 1))], axis=-1))


def _height_in(width_px: int, height_px: int) -> float:
    return float(np.clip(4.6 * height_px / width_px, 1.5, 6.0))


def _picture_axes(width_px: int, height_px: int) -> tuple[Figure, Axes]:
    return new_figure(WIDTH_IN, _height_in(width_px, height_px) + AXES_IN, "compressed")


def _framed(figure: Figure, axes: Axes, width_px: int, height_px: int) -> Figure:
    """Axes that are the picture's pixels."""
    axes.set(xlim=(-0.5, width_px - 0.5), ylim=(height_px - 0.5, -0.5), xlabel="u (px)", ylabel="v (px)")
    axes.set_aspect("equal", adjustable="box")
    axes.spines[["top", "right"]].set_visible(True)
    axes.tick_params(color=FAINT, labelcolor=INK)
    return figure


def _round_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between two numbers, or the two themselves."""
    powers = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    ticks = [float(step * 10.0**p) for p in powers for step in (1, 2, 5) if low <= step * 10.0**p <= high]
    return ticks if len(ticks) > 1 else [low, high]


def _short(name: str) -> str:
    return name if len(name) <= MOST_LETTERS else "…" + name[1 - MOST_LETTERS :]
