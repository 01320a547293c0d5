"""What each mode of the deformation costs, and how good a map must be: bars and a curve on logarithmic scales."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dishmap.plot.canvas import INK, Array, as_svg, new_figure
from dishmap.plot.rf_pattern import style_of

BARS_WIDTH_IN, BAR_IN, BARS_AXIS_IN = 8.4, 0.30, 1.1
MARGIN_IN = (6.8, 4.5)
# The axis of gain left on the table begins no lower: less than that nobody sees.
LEAST_DB = 1e-5


@as_svg
def mode_bars(names: Sequence[str], states: Sequence[str], loss_db: Array) -> Figure:
    """What each mode (M,) costs in each state, in dB: loss_db (S, M)."""
    figure, axes = new_figure(BARS_WIDTH_IN, BARS_AXIS_IN + BAR_IN * max(len(names), 3) * max(1.0, 0.6 * len(states)))
    thick = 0.8 / len(states)
    for k, state in enumerate(states):
        place = np.arange(len(names)) + (k - (len(states) - 1) / 2) * thick
        axes.barh(place, loss_db[k], color=style_of(state)["color"], height=0.92 * thick, label=state)
    axes.axvline(0.0, color="#666666", linewidth=0.8)
    axes.set_yticks(np.arange(len(names)), names, fontsize=9.5)
    axes.set(xlabel="won back by removing it (dB)", ylim=(len(names) - 0.4, -0.6))
    _grid(axes)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0, ncols=4, columnspacing=1.2)
    return figure


@as_svg
def margin_curves(curves: Mapping[str, tuple[Array, Array]], own_mm: float) -> Figure:
    """Gain left on the table by each kind of correction: noise of a target in mm and mean loss in dB (E,); own_mm: of this map."""
    figure, axes = new_figure(*MARGIN_IN)
    for name, (sigma, mean) in curves.items():
        axes.plot(sigma, np.maximum(mean, LEAST_DB), marker="o", markersize=3.5, label=name, **style_of(name))
    axes.axvline(own_mm, color=INK, linewidth=1.0, linestyle="--")
    at: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "xytext": (5, 0), "textcoords": "offset points", "va": "top"}
    axes.annotate(f"this map: {own_mm:.2g} mm", (own_mm, 0.97), **at)
    axes.set(xscale="log", yscale="log", xlabel="noise of each target of the map (mm, one sigma)", ylabel="gain left on the table (dB)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(which="major", color="#e0e0e0", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0, ncols=3, columnspacing=1.4)
    return figure


def _grid(axes: Axes) -> None:
    axes.grid(axis="x", color="#e0e0e0", linewidth=0.7)
    axes.set_axisbelow(True)
