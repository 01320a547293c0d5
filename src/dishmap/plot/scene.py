"""The fitted surface with its targets in space, as traces and layout for plotly.js.

Plain dictionaries: the library itself is not needed to make them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dishmap.pipeline import Map
from dishmap.plot.canvas import dot_size, round_length
from dishmap.surface.fit import SurfaceFit, surface_heights
from dishmap.verdict import Numbers, number

Array = NDArray[np.float64]

# Rings and spokes of the surface in the 3D picture: smooth to the eye, and 40 kB.
RINGS, SPOKES = 24, 73
# Residuals are drawn so that the largest takes about this part of the surface's width.
EXAGGERATED_PART = 0.08
# Where the eye stands, in units of the scene's size: a little above the rim.
EYE = {"x": 0.55, "y": -1.05, "z": 0.72}
SCENE_MARGIN = 0.04
FEW_TICKS = 4
PLOTLY_DIVERGING = [[0.0, "#053061"], [0.25, "#6aacd0"], [0.5, "#f7f7f7"], [0.75, "#e58368"], [1.0, "#67001f"]]


def exaggeration(fit: SurfaceFit, xy_mm: Array) -> float:
    """A round factor by which residuals are enlarged in the 3D picture, 1 or more."""
    largest = float(np.abs(fit.residual_mm[~fit.off_surface]).max(initial=0.0))
    return max(1.0, round_length(EXAGGERATED_PART * float(np.ptp(xy_mm, axis=0).max()) / largest)) if largest > 0 else 1.0


def scene_of(result: Map, numbers: Numbers, fit: SurfaceFit) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Traces and layout of the picture: the surface, and the residuals twice, enlarged and at true scale."""
    position = numbers.dish.position_mm
    factor = exaggeration(fit, position[:, :2])
    on = position[:, 2] - fit.residual_mm
    height = surface_heights(fit, position[:, 0], position[:, 1]).height_mm
    foot = np.where(np.isfinite(height), height, on)
    traces = [_mesh(fit)]
    for times in (factor, 1.0):
        top = foot + times * (position[:, 2] - foot)
        traces += _stems(result, numbers, fit, foot, top, visible=times == factor)
    choices = [
        {"label": label, "method": "restyle", "args": [{"visible": [True, *shown, *(not s for s in shown)]}]}
        for label, shown in ((f"residuals {factor:g} times enlarged", (True, True)), ("true scale", (False, False)))
    ]
    font = {"family": "system-ui, DejaVu Sans, Arial, sans-serif", "size": 13, "color": "#1a1a1a"}
    layout = {
        "margin": {"l": 0, "r": 0, "t": 40, "b": 0},
        "font": font,
        "paper_bgcolor": "#ffffff",
        "showlegend": False,
        "scene": _axes_of_scene(position[:, :2], np.concatenate([foot, foot + factor * (position[:, 2] - foot)])),
        "updatemenus": [
            {"type": "buttons", "direction": "right", "x": 0, "xanchor": "left", "y": 1.06, "yanchor": "top", "buttons": choices}
        ],
    }
    return traces, layout


def _axes_of_scene(xy_mm: Array, z_mm: Array) -> dict[str, Any]:
    """Axes with one scale for x, y and z, the longest of length 1."""
    low, high = np.array([*xy_mm.min(axis=0), z_mm.min()]), np.array([*xy_mm.max(axis=0), z_mm.max()])
    low, high = low - SCENE_MARGIN * (high - low).max(), high + SCENE_MARGIN * (high - low).max()
    axes: dict[str, Any] = {
        f"{name}axis": {"title": {"text": f"{name} (mm)"}, "range": [round(float(a), 3), round(float(b), 3)]}
        for name, a, b in zip("xyz", low, high, strict=True)
    }
    # a short axis has no room for many numbers
    axes["zaxis"]["nticks"] = FEW_TICKS
    ratio = {name: round(float(length), 4) for name, length in zip("xyz", (high - low) / (high - low).max(), strict=True)}
    return {**axes, "aspectmode": "manual", "aspectratio": ratio, "camera": {"eye": EYE, "center": {"x": 0, "y": 0, "z": -0.12}}}


def _mesh(fit: SurfaceFit) -> dict[str, Any]:
    """The fitted surface within the outline of its points, on rings from the middle outwards."""
    middle = fit.hull_mm.mean(axis=0)
    angle = np.linspace(0.0, 2 * np.pi, SPOKES)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    edge = np.roll(fit.hull_mm, -1, axis=0) - fit.hull_mm
    outward = np.column_stack([edge[:, 1], -edge[:, 0]])
    # a spoke ends at the first edge of the convex outline that it meets
    speed = direction @ outward.T
    room = np.where(speed > 1e-12, ((fit.hull_mm - middle) * outward).sum(axis=1) / np.where(speed > 1e-12, speed, 1.0), np.inf)
    spokes = direction * room.min(axis=1)[:, None]
    x, y = np.moveaxis(middle + np.linspace(0.0, 1.0, RINGS)[:, None, None] * spokes, -1, 0)
    height = surface_heights(fit, x, y).height_mm
    return {
        "type": "surface",
        "x": _listed(x, 2),
        "y": _listed(y, 2),
        "z": _listed(height, 4),
        "showscale": False,
        "opacity": 0.85,
        "colorscale": [[0, "#6fa8cf"], [1, "#d3e5f2"]],
        "hoverinfo": "skip",
        "contours": {axis: {"highlight": False} for axis in "xyz"},
    }


def _stems(result: Map, numbers: Numbers, fit: SurfaceFit, foot: Array, top: Array, visible: bool) -> list[dict[str, Any]]:
    """Lines from the surface to the targets, and the targets as dots coloured by residual."""
    x, y, _ = numbers.dish.position_mm.T
    gap = np.full_like(x, np.nan)
    line = [_listed(np.column_stack(three).ravel(), 4) for three in ((x, x, gap), (y, y, gap), (foot, top, gap))]
    limit = float(np.abs(fit.residual_mm[~fit.off_surface]).max(initial=0.0)) or 1.0
    dots = {
        "color": _listed(fit.residual_mm, 5),
        "colorscale": PLOTLY_DIVERGING,
        "cmin": -limit,
        "cmax": limit,
        "size": dot_size(len(x)),
        "line": {"color": "#1a1a1a", "width": 1},
        "colorbar": {"title": {"text": "residual (mm)"}, "thickness": 16, "len": 0.7, "exponentformat": "none"},
    }
    shared = {"type": "scatter3d", "visible": visible}
    lines = {"mode": "lines", "hoverinfo": "skip", "x": line[0], "y": line[1], "z": line[2], "line": {"color": "#555555", "width": 3}}
    points = {
        "mode": "markers",
        "marker": dots,
        "x": _listed(x, 4),
        "y": _listed(y, 4),
        "z": _listed(top, 4),
        "text": _hover_texts(result, numbers, fit),
        "hovertemplate": "%{text}<extra></extra>",
    }
    return [shared | lines, shared | points]


def _hover_texts(result: Map, numbers: Numbers, fit: SurfaceFit) -> list[str]:
    out = []
    for n, (x, y, z) in enumerate(numbers.dish.position_mm.tolist()):
        lines = [
            f"target {result.cloud.ids[n]}",
            f"x {x:.3f}, y {y:.3f}, z {z:.3f} mm (dish frame)",
            f"residual {fit.residual_mm[n]:.4f} mm",
        ]
        if numbers.sigma_depth_mm is not None:
            lines.append(f"sigma of depth {number(float(numbers.sigma_depth_mm[n]))} mm")
        out.append("<br>".join(lines))
    return out


def _listed(values: Array, digits: int) -> list[Any]:
    """Nested lists of rounded numbers, None for NaN, for JSON."""
    rounded = np.round(values, digits).astype(object)
    rounded[~np.isfinite(values)] = None
    return list(rounded.tolist())
