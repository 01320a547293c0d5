"""The changed surface in space, as traces and layout for plotly.js. Plain dictionaries: the library is not needed to make them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from dishmap.compare import DifferenceTable
from dishmap.difference_verdict import ROUNDING, set_aside, with_sigma
from dishmap.plot.canvas import dot_size, round_length

Array = NDArray[Any]

# The largest change is drawn as about this part of the surface's width.
EXAGGERATED_PART = 0.12
SCENE_MARGIN = 0.04
FEW_TICKS = 4
# A flat scene is drawn at least this high, a part of its width, so that the numbers on its axes do not meet.
LEAST_HEIGHT = 0.3
EYE = {"x": 0.55, "y": -1.05, "z": 0.72}
DIVERGING = [[0.0, "#053061"], [0.25, "#6aacd0"], [0.5, "#f7f7f7"], [0.75, "#e58368"], [1.0, "#67001f"]]
# The scale of colours reaches at least so many sigmas, and so does what fills the exaggerated part: noise is not blown up.
LEAST_SIGMAS = 3.0


def exaggeration(table: DifferenceTable) -> float:
    """A round factor by which changes of shape are enlarged in the 3D picture, 1 or more."""
    limit = _limit(table)
    span = float(np.ptp(table.nominal_mm[:, :2], axis=0).max())
    return max(1.0, round_length(EXAGGERATED_PART * span / limit)) if limit > ROUNDING and span > 0 else 1.0


def difference_scene(table: DifferenceTable, normal: Array) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Traces and layout: the surface with its change of shape, enlarged and at true scale, over its nominal outline.

    normal (N, 3): nominal normals of the table's targets, along which changes are drawn.
    """
    factor = exaggeration(table)
    triangles = _triangles(table.nominal_mm[:, :2])
    shown = [table.nominal_mm + times * table.shape_mm[:, None] * normal for times in (factor, 1.0)]
    traces = [_net(table, triangles)]
    for points, visible in zip(shown, (True, False), strict=True):
        traces += [*_skin(table, points, triangles, visible), _dots(table, points, visible)]
    each = (len(traces) - 1) // 2
    choices = [
        {"label": label, "method": "restyle", "args": [{"visible": [True, *[first] * each, *[not first] * each]}]}
        for label, first in ((f"change {factor:g} times enlarged", True), ("true scale", False))
    ]
    layout = {
        "margin": {"l": 0, "r": 0, "t": 40, "b": 0},
        "font": {"family": "system-ui, DejaVu Sans, Arial, sans-serif", "size": 13, "color": "#1a1a1a"},
        "paper_bgcolor": "#ffffff",
        "showlegend": False,
        "scene": _axes(np.concatenate([*shown, table.nominal_mm])),
        "updatemenus": [
            {"type": "buttons", "direction": "right", "x": 0, "xanchor": "left", "y": 1.06, "yanchor": "top", "buttons": choices}
        ],
    }
    return traces, layout


def _limit(table: DifferenceTable) -> float:
    """End of the scale of colours, mm; 0 where nothing changed and no sigma is known."""
    used = ~set_aside(table)
    known = table.sigma_shape_mm[np.isfinite(table.sigma_shape_mm)]
    floor = LEAST_SIGMAS * float(np.median(known)) if known.size else 0.0
    return max(float(np.abs(table.shape_mm[used]).max(initial=0.0)), floor)


def _triangles(xy_mm: Array) -> Array:
    """Triangles (K, 3) between neighbouring points; none where the points span no area."""
    try:
        return np.asarray(Delaunay(xy_mm).simplices) if len(xy_mm) > 2 else np.empty((0, 3), int)
    except QhullError:
        return np.empty((0, 3), int)


def _axes(points: Array) -> dict[str, Any]:
    """Axes with one scale for x, y and z, the longest of length 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    span = float((high - low).max()) or 1.0
    low, high = low - SCENE_MARGIN * span, high + SCENE_MARGIN * span
    room = max(0.0, LEAST_HEIGHT * span - float(high[2] - low[2]))
    low[2], high[2] = low[2] - room / 2, high[2] + room / 2
    axes: dict[str, Any] = {
        f"{name}axis": {"title": {"text": f"{name} (mm)"}, "range": [round(float(a), 3), round(float(b), 3)]}
        for name, a, b in zip("xyz", low, high, strict=True)
    }
    # a short axis has no room for many numbers
    axes["zaxis"]["nticks"] = FEW_TICKS
    ratio = {name: round(float(length), 4) for name, length in zip("xyz", (high - low) / (high - low).max(), strict=True)}
    return {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": EYE, "center": {"x": 0, "y": 0, "z": -0.12}}}


def _net(table: DifferenceTable, triangles: Array) -> dict[str, Any]:
    """The nominal surface as grey lines between neighbours."""
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    ends = table.nominal_mm[edges]
    lines = np.concatenate([ends, np.full_like(ends[:, :1], np.nan)], axis=1).reshape(-1, 3)
    where = {axis: _listed(lines[:, i], 2) for i, axis in enumerate("xyz")}
    return {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip", "line": {"color": "#9a9a9a", "width": 1.5}, **where}


def _skin(table: DifferenceTable, points: Array, triangles: Array, visible: bool) -> list[dict[str, Any]]:
    """The changed surface, coloured by the change of shape."""
    if not len(triangles):
        return []
    corners = {name: triangles[:, i].tolist() for i, name in enumerate("ijk")}
    where = {axis: _listed(points[:, i], 4) for i, axis in enumerate("xyz")}
    mesh = {"type": "mesh3d", "visible": visible, "intensity": _listed(table.shape_mm, 6), "hoverinfo": "skip", "opacity": 0.92}
    light = {"ambient": 0.75, "diffuse": 0.45, "specular": 0.05, "roughness": 0.9}
    return [{**mesh, **where, **corners, **_colors(table), "showscale": False, "lighting": light, "flatshading": False}]


def _dots(table: DifferenceTable, points: Array, visible: bool) -> dict[str, Any]:
    """The targets, coloured by the change of shape; those put aside are crosses."""
    aside = set_aside(table)
    marker = {
        "color": _listed(table.shape_mm, 6),
        **_colors(table),
        "size": dot_size(len(points)),
        "symbol": ["x" if a else "circle" for a in aside.tolist()],
        "line": {"color": "#1a1a1a", "width": 1},
        "colorbar": {"title": {"text": "change of<br>shape (mm)"}, "thickness": 16, "len": 0.7, "exponentformat": "none"},
    }
    where = {axis: _listed(points[:, i], 4) for i, axis in enumerate("xyz")}
    told = {"text": _hover_texts(table), "hovertemplate": "%{text}<extra></extra>"}
    return {"type": "scatter3d", "mode": "markers", "visible": visible, "marker": marker, **where, **told}


def _colors(table: DifferenceTable) -> dict[str, Any]:
    limit = _limit(table)
    limit = limit if limit > ROUNDING else 1.0
    return {"colorscale": DIVERGING, "cmin": -limit, "cmax": limit}


def _hover_texts(table: DifferenceTable) -> list[str]:
    out = []
    for n, (x, y, z) in enumerate(table.nominal_mm.tolist()):
        shape = with_sigma(float(table.shape_mm[n]), float(table.sigma_shape_mm[n]), " mm", sign=True)
        moved = with_sigma(float(table.displacement_mm[n]), float(table.sigma_displacement_mm[n]), " mm", sign=True)
        lines = [f"target {table.ids[n]}", f"x {x:.1f}, y {y:.1f}, z {z:.1f} mm (dish frame)", f"change of shape {shape}"]
        out.append("<br>".join([*lines, f"displacement {moved}"]))
    return out


def _listed(values: Array, digits: int) -> list[Any]:
    """Lists of rounded numbers, None for NaN, for JSON."""
    rounded = np.round(values, digits).astype(object)
    rounded[~np.isfinite(values)] = None
    return list(rounded.tolist())
