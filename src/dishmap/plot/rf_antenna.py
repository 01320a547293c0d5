"""The antenna from its two sides: dish, rays, and the subreflector or feed where it should be and where the correction moves it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dishmap.plot.canvas import BLUE, FAINT, INK, ORANGE, Array, as_svg, round_length
from dishmap.rf.antenna import Antenna
from dishmap.rf.correction import Correction, correction_of, no_correction
from dishmap.rf.deformation import Deformation, displacement
from dishmap.rf.rays import feed_place, trace
from dishmap.rf.subreflector import patch, sub_surface
from dishmap.transforms import rotation_from_vector

# The picture's width, what labels take of it at the sides, and what they take above and below; free room around what is drawn.
WIDTH_IN, SIDES_IN, TOP_IN, MARGIN = 10.8, 0.9, 1.15, 0.04
RAYS, POINTS = 9, 201
# Moves are drawn so large that the largest is about this part of the aperture, turns so that they show as much at a rim.
DISH_PART, SUB_PART = 0.05, 0.06
# Below this (mm) nothing moved.
STILL_MM = 1e-6
# The feed is drawn as a horn of this part of the aperture.
HORN_PART = 0.05


@as_svg
def antenna_sides(antenna: Antenna, deformation: Deformation, correction: Correction) -> Figure:
    """Sections of the antenna along x and along y through the middle of its aperture, projected; motions are drawn enlarged."""
    dish, moved = dish_factor(antenna, deformation), move_factor(antenna, correction)
    figure = Figure(layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, along in zip(panels, (0, 1), strict=True):
        _dish(axes, antenna, deformation, along, dish)
        _rays(axes, antenna, along)
        if antenna.subreflector is None:
            _horn(axes, antenna, no_correction(antenna), along, INK, "feed")
            if moved:
                _horn(axes, antenna, _larger(correction, moved), along, BLUE, f"feed, moved ({_times(moved)})")
        else:
            _horn(axes, antenna, no_correction(antenna), along, INK, "")
            _sub(axes, antenna, no_correction(antenna), along, INK, "subreflector")
            if moved:
                _sub(axes, antenna, _larger(correction, moved), along, BLUE, f"subreflector, moved ({_times(moved)})")
        axes.set(xlabel=f"{'xy'[along]} (mm)", ylabel="z (mm)" if along == 0 else "")
    _to_scale(figure, panels)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4, borderpad=0.2)
    return figure


def dish_factor(antenna: Antenna, deformation: Deformation) -> float:
    """How many times enlarged the deformation is drawn; 0 where there is none."""
    points = np.concatenate([_line(antenna, along) for along in (0, 1)])
    largest = float(np.abs(displacement(deformation, points)[0]).max())
    return round_length(DISH_PART * antenna.reflector.diameter_mm / largest) if largest > STILL_MM else 0.0


def move_factor(antenna: Antenna, correction: Correction) -> float:
    """How many times enlarged the correction is drawn; 0 where it moves nothing."""
    size = _size_mm(antenna)
    parts = [np.abs(correction.shift_mm).max(), np.abs(np.radians(correction.tilt_deg)).max() * size]
    largest = float(max(*parts, np.abs(correction.shape_mm).sum()))
    return round_length(max(SUB_PART * antenna.reflector.diameter_mm / largest, 1.0)) if largest > STILL_MM else 0.0


def _times(factor: float) -> str:
    return f"{factor:g} times" if factor != 1 else "true scale"


def _larger(correction: Correction, factor: float) -> Correction:
    return correction_of(correction.values * factor)


def _size_mm(antenna: Antenna) -> float:
    """Radius of what is moved."""
    if antenna.subreflector is None:
        return HORN_PART * antenna.reflector.diameter_mm
    return sub_surface(antenna, no_correction(antenna)).radius_mm


def _line(antenna: Antenna, along: int, count: int = POINTS) -> Array:
    """Places (count, 2) across the aperture through its middle, along x (0) or y (1)."""
    out = np.tile(antenna.reflector.center_mm, (count, 1))
    out[:, along] += np.linspace(-0.5, 0.5, count) * antenna.reflector.diameter_mm
    return out


def _on_dish(antenna: Antenna, xy: Array) -> Array:
    return np.column_stack([xy, (xy**2).sum(axis=1) / (4 * antenna.reflector.focal_length_mm)])


def _dish(axes: Axes, antenna: Antenna, deformation: Deformation, along: int, factor: float) -> None:
    xy = _line(antenna, along)
    points = _on_dish(antenna, xy)
    axes.plot(points[:, along], points[:, 2], color=INK, linewidth=1.6, label="dish")
    if factor:
        normal = np.column_stack([-xy / (2 * antenna.reflector.focal_length_mm), np.ones(len(xy))])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        bent = points + factor * displacement(deformation, xy)[0][:, None] * normal
        axes.plot(bent[:, along], bent[:, 2], color=ORANGE, linewidth=1.6, label=f"dish, measured ({_times(factor)})")


def _rays(axes: Axes, antenna: Antenna, along: int) -> None:
    """From the feed over the subreflector to the dish and out, as designed."""
    points = _on_dish(antenna, _line(antenna, along, RAYS + 2)[1:-1])
    feed = feed_place(antenna)
    rays = trace(antenna, feed, points, no_correction(antenna))
    top = max(antenna.reflector.focal_length_mm, float(np.nanmax(rays.reflection_mm[:, 2], initial=0.0))) * 1.08
    for point, middle, lost in zip(points, rays.reflection_mm, rays.lost, strict=True):
        if not lost:
            stops = [feed.center_mm, *([] if np.isnan(middle).any() else [middle]), point, np.array([point[0], point[1], top])]
            way = np.array(stops)
            axes.plot(way[:, along], way[:, 2], color=FAINT, linewidth=0.7, zorder=1)


def _sub(axes: Axes, antenna: Antenna, correction: Correction, along: int, color: str, label: str) -> None:
    surface = sub_surface(antenna, correction)
    own = np.tile([surface.center_mm, 0.0], (POINTS, 1))
    own[:, along] += np.linspace(-1.0, 1.0, POINTS) * surface.radius_mm
    points = patch(surface, own).point_mm
    axes.plot(points[:, along], points[:, 2], color=color, linewidth=2.0, label=label, zorder=3)


def _horn(axes: Axes, antenna: Antenna, correction: Correction, along: int, color: str, label: str) -> None:
    """The feed as a horn whose mouth is its phase centre; only a feed at the prime focus moves."""
    place, size = feed_place(antenna), HORN_PART * antenna.reflector.diameter_mm
    outline = np.array([[-0.5, 0.0], [0.5, 0.0], [0.25, -1.0], [-0.25, -1.0], [-0.5, 0.0]]) * size
    own = np.zeros((len(outline), 3))
    own[:, along], own[:, 2] = outline.T
    turn, shift = np.eye(3), np.zeros(3)
    if antenna.subreflector is None:
        turn, shift = rotation_from_vector([*np.radians(correction.tilt_deg), 0.0]), correction.shift_mm
    points = place.center_mm + shift + own @ (turn @ place.rotation).T
    axes.plot(points[:, along], points[:, 2], color=color, linewidth=1.6, label=label or None, zorder=3)


def _to_scale(figure: Figure, panels: Sequence[Axes]) -> None:
    """Sizes of figure and panels in which millimetres are the same length everywhere and nothing is cut."""
    margin = MARGIN * max(axes.dataLim.width for axes in panels)
    spans = [axes.dataLim.width + 2 * margin for axes in panels]
    low, high = min(axes.dataLim.y0 for axes in panels), max(axes.dataLim.y1 for axes in panels)
    for axes in panels:
        axes.set(xlim=(axes.dataLim.x0 - margin, axes.dataLim.x1 + margin), ylim=(low - margin, high + margin), aspect="equal")
    grid = panels[0].get_gridspec()
    assert grid is not None
    grid.set_width_ratios(spans)
    body = (WIDTH_IN - SIDES_IN) * (high - low + 2 * margin) / sum(spans)
    figure.set_size_inches(WIDTH_IN, body + TOP_IN)
