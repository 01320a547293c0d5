"""Charts of a difference: maps over the dish as seen from its focus (x to the right, y up, millimetres), bars and a histogram."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import chi

from dishmap.difference_verdict import ROUNDING, TOLD_SIGMAS
from dishmap.plot.canvas import BLUE, DIVERGING, FAINT, INK, ORANGE, RED, SEQUENTIAL, Array, as_svg, new_figure
from dishmap.plot.maps import dish_axes, fill_map, map_figure, marks

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

# Lower than other maps: a legend stands above.
BODY_IN = 4.3
CHART_IN = (6.2, 4.4)
# The scale of a change reaches at least so many sigmas, so that noise never looks like a strong change.
LEAST_SIGMAS = 3.0
# Names beside points stay readable up to so many.
MOST_NAMES = 12
# Beyond so many pairs lines between targets hide each other, and dots at their middles are drawn.
MOST_LINES = 800
# Zernike bars: width, height of one, and room for the axis.
BARS_WIDTH_IN, BAR_IN, BARS_AXIS_IN = 8.4, 0.27, 1.1
# A change of a target has six parts: three moves and three turns.
DIRECTIONS = 6
# Misfits are binned up to here, the rest is in the last bin.
MISFIT_REACH, MISFIT_BINS = 3.0, 30
# The scale of misfits reaches at least so far, so that those of noise look alike.
LEAST_MISFIT_SHOWN = 2.0


@as_svg
def change_map(xy_mm: Array, change_mm: Array, sigma_mm: Array, aside: Bools, ids: Ints, label: str) -> Figure:
    """Changes (N,) at points (N, 2), filled between them, in colours that are symmetric about zero.

    sigma_mm (N,): NaN where unknown; changes that it tells from zero have a dark outline. aside: not used, drawn as crosses.
    """
    figure, axes = map_figure(xy_mm, BODY_IN)
    used = ~aside
    norm = Normalize(-(limit := _limit(change_mm[used], sigma_mm[used])), limit)
    fill_map(axes, xy_mm[used], change_mm[used], norm, DIVERGING)
    told = ~(np.abs(change_mm) < TOLD_SIGMAS * sigma_mm)
    for some, size, edge, words in (
        (used & told, 30, INK, f"beyond {TOLD_SIGMAS:g} sigma"),
        (used & ~told, 13, FAINT, f"within {TOLD_SIGMAS:g} sigma of zero"),
    ):
        if some.any():
            x, y = xy_mm[some].T
            colors: dict[str, Any] = {"c": change_mm[some], "cmap": DIVERGING, "norm": norm, "edgecolors": edge}
            axes.scatter(x, y, zorder=3, label=words, **{**marks(xy_mm, size), **colors})
    _crosses(axes, xy_mm, aside, ids)
    if np.isfinite(sigma_mm).any() or aside.any():
        _legend(figure)
    figure.colorbar(_mappable(norm, DIVERGING), ax=axes, label=label)
    dish_axes(axes, xy_mm)
    return figure


@as_svg
def misfit_map(xy_mm: Array, misfit: Array, aside: Bools, ids: Ints) -> Figure:
    """Misfits (N,), in sigmas, at points (N, 2); not filled, since they say nothing of what lies between. aside: drawn as crosses."""
    figure, axes = map_figure(xy_mm, BODY_IN)
    used = ~aside
    norm = Normalize(0.0, max(LEAST_MISFIT_SHOWN, float(misfit[used].max(initial=0.0))))
    x, y = xy_mm[used].T
    axes.scatter(x, y, c=misfit[used], label="used", cmap=SEQUENTIAL, norm=norm, zorder=3, **marks(xy_mm, 60))
    _crosses(axes, xy_mm, aside, ids)
    if aside.any():
        _legend(figure)
    figure.colorbar(_mappable(norm, SEQUENTIAL), ax=axes, label="misfit (sigmas)")
    dish_axes(axes, xy_mm)
    return figure


@as_svg
def ratio_map_chart(place_mm: Array, pair: Ints, ratio: Array, used: Bools) -> Figure:
    """The paper's ratios (M,) of pairs (M, 2) of targets at place_mm (T, 2), less one, in percent; pairs not used are grey."""
    figure, axes = map_figure(place_mm, BODY_IN)
    percent = 100 * (ratio - 1)
    limit = float(np.abs(percent[used]).max(initial=0.0)) or 1.0
    norm = Normalize(-limit, limit)
    ends, few = place_mm[pair], len(pair) <= MOST_LINES
    if few:
        axes.add_collection(LineCollection(list(ends[~used]), colors=FAINT, linewidths=1.0, linestyles="dotted", zorder=1))
        # a grey line under the coloured one keeps pale ratios visible
        axes.add_collection(LineCollection(list(ends[used]), colors=FAINT, linewidths=3.8, zorder=2))
        lines = LineCollection(list(ends[used]), cmap=DIVERGING, norm=norm, linewidths=3.0, zorder=3)
        lines.set_array(percent[used])
        axes.add_collection(lines)
    else:
        x, y = ends[used].mean(axis=1).T
        axes.scatter(x, y, c=percent[used], cmap=DIVERGING, norm=norm, s=9, zorder=2)
    axes.scatter(place_mm[:, 0], place_mm[:, 1], s=marks(place_mm, 10)["s"], color=INK, zorder=4)
    figure.colorbar(_mappable(norm, DIVERGING), ax=axes, label="ratio of distances - 1 (%)")
    dish_axes(axes, place_mm)
    return figure


@as_svg
def misfit_histogram(misfit: Array, aside: Bools) -> Figure:
    """Histogram of misfits (N,), the root of chi-square over six, with the curve that noise alone gives before anything is fitted."""
    figure, axes = new_figure(*CHART_IN)
    inside = np.clip(misfit, 0.0, MISFIT_REACH - 1e-9)
    groups, names, colors = [inside[~aside]], ["used"], ["#a6cee3"]
    if aside.any():
        groups, names, colors = [*groups, inside[aside]], [*names, "put aside"], [*colors, ORANGE]
    style: dict[str, Any] = {"range": (0.0, MISFIT_REACH), "stacked": True, "edgecolor": "#4d7ea8", "linewidth": 0.6}
    axes.hist(groups, bins=MISFIT_BINS, color=colors, label=names, **style)
    x = np.linspace(0.0, MISFIT_REACH, 301)
    root = np.sqrt(DIRECTIONS)
    expected = len(misfit) * MISFIT_REACH / MISFIT_BINS * root * chi.pdf(root * x, DIRECTIONS)
    axes.plot(x, expected, color=INK, label="noise alone, nothing fitted")
    axes.set(xlabel="misfit (sigmas)", ylabel="targets", xlim=(0.0, MISFIT_REACH))
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0, ncols=3, columnspacing=1.2)
    return figure


@as_svg
def zernike_bars(names: Sequence[str], size_mm: Array, sigma_mm: Array) -> Figure:
    """A bar for each Zernike term (T,) with its sigma as error bar; grey where it is not told from zero."""
    figure, axes = new_figure(BARS_WIDTH_IN, BARS_AXIS_IN + BAR_IN * max(len(names), 3))
    place = np.arange(len(names))
    told = np.abs(size_mm) >= TOLD_SIGMAS * sigma_mm
    for some, color, words in ((told, BLUE, f"beyond {TOLD_SIGMAS:g} sigma"), (~told, "#b8b8b8", f"within {TOLD_SIGMAS:g} sigma of zero")):
        if some.any():
            axes.barh(place[some], size_mm[some], color=color, height=0.66, label=words)
    axes.errorbar(size_mm, place, xerr=sigma_mm, fmt="none", ecolor=INK, elinewidth=1.3, capsize=2.5, label="one sigma")
    axes.axvline(0.0, color="#666666", linewidth=0.8)
    axes.set_yticks(place, names, fontsize=9.5)
    axes.set(xlabel="size at the rim (mm)", ylim=(len(names) - 0.4, -0.6))
    axes.grid(axis="x", color="#e0e0e0", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0, ncols=3, columnspacing=1.2)
    return figure


def _limit(change: Array, sigma: Array) -> float:
    """End of a scale that is symmetric about zero."""
    known = sigma[np.isfinite(sigma)]
    floor = LEAST_SIGMAS * float(np.median(known)) if known.size else 0.0
    limit = max(float(np.abs(change).max(initial=0.0)), floor)
    return limit if limit > ROUNDING else 1.0


def _mappable(norm: Normalize, colors: str) -> Any:
    return ScalarMappable(norm, colors)


def _crosses(axes: Axes, xy_mm: Array, aside: Bools, ids: Ints) -> None:
    """Targets whose change was not used, with their ids when they are few."""
    if not aside.any():
        return
    x, y = xy_mm[aside].T
    axes.scatter(x, y, marker="X", c=ORANGE, zorder=4, label="put aside", **marks(xy_mm, 60))
    if aside.sum() <= MOST_NAMES:
        for (x, y), ident in zip(xy_mm[aside], ids[aside], strict=True):
            named = axes.annotate(str(ident), (x, y), xytext=(6, 6), textcoords="offset points", color=RED, fontsize=10, zorder=5)
            named.set_in_layout(False)


def _legend(figure: Figure) -> None:
    # beside the axes a wide legend would make them smaller
    figure.legend(loc="outside upper left", borderpad=0.2, ncols=3, columnspacing=1.0, handletextpad=0.3, fontsize=9.5)
