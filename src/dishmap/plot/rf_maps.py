"""Maps over an antenna's aperture, as seen from the focus: x to the right, y up, millimetres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dishmap.plot.canvas import DIVERGING, INK, SEQUENTIAL, Array, as_svg, color_norm
from dishmap.plot.maps import dish_axes, plain_ticks

Bools = NDArray[np.bool_]

PANEL_IN, BAR_IN = 3.5, 1.3
# Fields are drawn on so many cells a side: contours of ten thousand nodes would make pages of many megabytes.
SIDE = 161
# Each cell takes so many places around it; a little of a flat one where they lie in a line. Cells end this little beyond the rim, in radii.
NEAREST, RIDGE, EDGE = 8, 1e-9, 1.02
# Targets are dots: smaller ones where there are many.
DOT_AREA_PT2, SMALLEST_DOT_PT2, ROOMY_COUNT = 13.0, 1.5, 100
# Room for hatching on the page: lines this many to the unit.
HATCH = "//"


@as_svg
def aperture_maps(
    xy_mm: Sequence[Array], values: Sequence[Array], names: Sequence[str], center_mm: Array, radius_mm: float, label: str
) -> Figure:
    """Values (N,) at places (N, 2) of an aperture, one panel each and one scale of colours for all, symmetric about zero."""
    limit = max(float(np.abs(one).max(initial=0.0)) for one in values) or 1.0
    norm = Normalize(-limit, limit)
    figure = Figure(figsize=(PANEL_IN * len(values) + BAR_IN, PANEL_IN + 0.5), layout="compressed")
    panels = figure.subplots(1, len(values), squeeze=False, sharey=True)[0]
    for axes, xy, one, name in zip(panels, xy_mm, values, names, strict=True):
        _field(axes, _raster(xy, one, center_mm, radius_mm), center_mm, radius_mm, norm, DIVERGING)
        dish_axes(axes, xy)
        axes.set_title(name, fontsize=11)
    for axes in panels[1:]:
        axes.set_ylabel("")
    figure.colorbar(ScalarMappable(norm, DIVERGING), ax=list(panels), label=label)
    return figure


@as_svg
def sigma_field(xy_mm: Array, sigma_mm: Array, beyond: Bools, targets_mm: Array, center_mm: Array, radius_mm: float, label: str) -> Figure:
    """Sigmas (N,) at places (N, 2) of an aperture, hatched where they are extrapolated (`beyond` (N,)), and targets (T, 2) as dots."""
    # as large as one panel of `aperture_maps`, beside which it stands
    figure = Figure(figsize=(PANEL_IN + BAR_IN, PANEL_IN + 0.5), layout="compressed")
    axes = figure.subplots()
    norm = color_norm(sigma_mm)
    _field(axes, _raster(xy_mm, sigma_mm, center_mm, radius_mm), center_mm, radius_mm, norm, SEQUENTIAL)
    _hatch(axes, _raster(xy_mm, beyond.astype(float), center_mm, radius_mm), center_mm, radius_mm)
    area = max(DOT_AREA_PT2 * min(1.0, ROOMY_COUNT / max(len(targets_mm), 1)), SMALLEST_DOT_PT2)
    axes.scatter(targets_mm[:, 0], targets_mm[:, 1], s=area, color="white", edgecolors=INK, linewidths=0.4, zorder=4)
    bar = figure.colorbar(ScalarMappable(norm, SEQUENTIAL), ax=axes, label=label)
    if isinstance(norm, LogNorm):
        plain_ticks(bar, norm)
    dish_axes(axes, np.concatenate([xy_mm, targets_mm]))
    return figure


def _raster(xy: Array, values: Array, center: Array, radius: float) -> Array:
    """Values at the cells of a square about the aperture: of planes through the nearest places, by weighted least squares."""
    side = np.linspace(-1.0, 1.0, SIDE)
    cells = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    places = (xy - center) / radius
    distance, near = cKDTree(places).query(cells, k=min(NEAREST, len(places)))
    reach = distance[:, -1:] * (1 + 1e-9) + 1e-12
    weight = (1 - (distance / reach) ** 2) ** 2 + 1e-6
    columns = np.concatenate([np.ones((*near.shape, 1)), (places[near] - cells[:, None]) / reach[..., None]], axis=2)
    left = np.einsum("ck,cki,ckj->cij", weight, columns, columns) + RIDGE * np.eye(3)
    right = np.einsum("ck,cki,ck->ci", weight, columns, values[near])
    out: Array = np.linalg.solve(left, right[..., None])[:, 0, 0]
    # beyond the aperture nothing is drawn, and planes would lead far off
    beyond = np.hypot(*cells.T) > EDGE
    out[beyond] = values[near[beyond, 0]]
    return out.reshape(SIDE, SIDE)


def _field(axes: Axes, raster: Array, center: Array, radius: float, norm: Normalize, colors: str) -> None:
    rim = Circle((float(center[0]), float(center[1])), radius, fill=False, edgecolor=INK, linewidth=0.8, zorder=3)
    axes.add_patch(rim)
    picture = axes.imshow(raster, origin="lower", extent=_extent(center, radius), norm=norm, cmap=colors, interpolation="bilinear")
    picture.set_clip_path(rim)


def _hatch(axes: Axes, beyond: Array, center: Array, radius: float) -> None:
    """Lines over the part where values are extrapolated, and its border."""
    if not (beyond > 0.5).any():
        return
    x, y = (c + np.linspace(-radius, radius, SIDE) for c in center)
    within = np.hypot(x[None, :] - center[0], y[:, None] - center[1]) <= radius
    marked = np.where(within, beyond, np.nan)
    axes.contourf(x, y, marked, levels=[0.5, 1.5], colors="none", hatches=[HATCH], zorder=2)
    if (beyond < 0.5).any():
        axes.contour(x, y, marked, levels=[0.5], colors=INK, linewidths=1.0, linestyles="dashed", zorder=3)


def _extent(center: Array, radius: float) -> tuple[float, float, float, float]:
    # cells are centred on their places
    reach = radius * SIDE / (SIDE - 1)
    return float(center[0]) - reach, float(center[0]) + reach, float(center[1]) - reach, float(center[1]) + reach
