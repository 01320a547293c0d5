"""Far-field patterns and gain against frequency, of several states of an antenna beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dishmap.plot.canvas import BLUE, FAINT, INK, ORANGE, SEQUENTIAL, as_svg, new_figure
from dishmap.rf.pattern import decibels
from dishmap.rf.state import Reading, State

GREEN, PURPLE = "#009e73", "#cc79a7"
STYLES: dict[str, dict[str, Any]] = {
    "design": {"color": FAINT, "linestyle": (0, (4, 2)), "linewidth": 1.4},
    "measured": {"color": ORANGE, "linestyle": "-", "linewidth": 1.6},
    "corrected": {"color": BLUE, "linestyle": "-", "linewidth": 1.6},
    "shaped": {"color": GREEN, "linestyle": (0, (6, 1, 1, 1)), "linewidth": 1.6},
}
# dots are for what is cross-polar
OTHER_STYLE: dict[str, Any] = {"color": PURPLE, "linestyle": (0, (3, 1, 1, 1, 1, 1)), "linewidth": 1.6}
CUT_PANEL_IN, PATTERN_PANEL_IN, BAR_IN = (5.2, 3.3), 3.3, 1.2
CURVE_IN = (7.4, 4.4)
# Patterns are drawn from so many dB below their highest peak.
FLOOR_DB, GRID_FLOOR_DB = 55.0, 50.0
# Headroom over the highest peak.
HEADROOM_DB = 3.0


@as_svg
def pattern_cuts(readings: Sequence[Reading], names: Sequence[str], cross_of: int) -> Figure:
    """Cuts of the same planes of several states, in dBi; the cross-polar field of the one at `cross_of` is dotted."""
    planes = len(readings[0].cuts)
    rows = (planes + 1) // 2
    figure = Figure(figsize=(2 * CUT_PANEL_IN[0], rows * CUT_PANEL_IN[1] + 0.4), layout="constrained")
    panels = figure.subplots(rows, 2, squeeze=False, sharex=True, sharey=True).ravel()
    top = max(float(decibels(np.abs(cut.co) ** 2).max()) for reading in readings for cut in reading.cuts)
    for k, axes in enumerate(panels[:planes]):
        for reading, name in zip(readings, names, strict=True):
            cut = reading.cuts[k]
            axes.plot(cut.theta_deg, decibels(np.abs(cut.co) ** 2), label=name, **style_of(name))
        cut = readings[cross_of].cuts[k]
        cross = {**style_of(names[cross_of]), "linestyle": ":", "linewidth": 1.0}
        axes.plot(cut.theta_deg, decibels(np.abs(cut.cross) ** 2), label=f"{names[cross_of]}, cross-polar", **cross)
        axes.set_title(f"φ = {cut.phi_deg:g}°", fontsize=11)
        axes.set(xlim=(cut.theta_deg[0], cut.theta_deg[-1]), ylim=(top - FLOOR_DB, top + HEADROOM_DB))
        _grid(axes)
    for k, axes in enumerate(panels):
        axes.set_xlabel("θ from boresight (degrees)" if k >= planes - 2 else "")
        axes.set_ylabel("gain (dBi)" if k % 2 == 0 else "")
        axes.set_visible(k < planes)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=5, borderpad=0.2)
    return figure


@as_svg
def pattern_maps(readings: Sequence[Reading], names: Sequence[str]) -> Figure:
    """Co-polar gain over direction cosines, one panel a state and one scale of colours for all; a cross marks each peak."""
    power = [decibels(np.abs(reading.grid.co) ** 2) for reading in readings]
    top = max(float(np.nanmax(one)) for one in power)
    norm = Normalize(top - GRID_FLOOR_DB, top)
    figure = Figure(figsize=(PATTERN_PANEL_IN * len(readings) + BAR_IN, PATTERN_PANEL_IN + 0.5), layout="compressed")
    panels = figure.subplots(1, len(readings), squeeze=False, sharey=True)[0]
    for axes, reading, one, name in zip(panels, readings, power, names, strict=True):
        grid = reading.grid
        axes.imshow(one, origin="lower", extent=(grid.u[0], grid.u[-1], grid.v[0], grid.v[-1]), norm=norm, cmap=SEQUENTIAL, aspect="equal")
        axes.plot(reading.beam.u, reading.beam.v, "+", color=INK, markersize=9, markeredgewidth=1.2)
        axes.set_title(name, fontsize=11)
        axes.set_xlabel("u = sin θ cos φ")
    panels[0].set_ylabel("v = sin θ sin φ")
    figure.colorbar(ScalarMappable(norm, SEQUENTIAL), ax=list(panels), label="co-polar gain (dBi)")
    return figure


@as_svg
def gain_curves(states: Sequence[State]) -> Figure:
    """Gain at the beam's peak against frequency, with the middle 95 % of the drawn surfaces at the frequencies that were asked for."""
    figure, axes = new_figure(*CURVE_IN)
    for state in states:
        style = style_of(state.name)
        axes.plot(state.sweep_ghz, state.sweep_dbi, label=state.name, **style)
        for reading in state.readings:
            axes.plot(reading.frequency_ghz, reading.beam.gain_dbi, "o", color=style["color"], markersize=4)
            if reading.spread is not None:
                low, high = reading.spread.interval("gain_dbi")
                axes.plot([reading.frequency_ghz] * 2, [low, high], color=style["color"], linewidth=3.5, alpha=0.45, solid_capstyle="butt")
    axes.set(xlabel="frequency (GHz)", ylabel="gain at the beam's peak (dBi)")
    axes.set_xlim(float(states[0].sweep_ghz[0]), float(states[0].sweep_ghz[-1]))
    _grid(axes)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0, ncols=5, columnspacing=1.4)
    return figure


def style_of(name: str) -> dict[str, Any]:
    """How the curves of a state are drawn."""
    return STYLES.get(name, OTHER_STYLE)


def _grid(axes: Axes) -> None:
    axes.grid(color="#e0e0e0", linewidth=0.7)
    axes.set_axisbelow(True)
