"""Charts of a camera's calibration: how well each view fits, and where in the picture the board was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dishmap.plot.canvas import BLUE, FAINT, INK, ORANGE, SEQUENTIAL, Array, as_svg, new_figure

WIDTH_IN, BAR_IN, AXES_IN = 6.2, 0.24, 0.9
# Beyond so many views only their numbers are written, and names are cut at so many letters.
MOST_NAMED, MOST_LETTERS = 60, 24
# The scale of colours ends here, so that a few outliers do not wash out the rest.
LARGEST_QUANTILE = 0.99


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
    figure, axes = new_figure(WIDTH_IN, float(np.clip(4.6 * height_px / width_px, 1.5, 6.0)) + AXES_IN, "compressed")
    length = np.hypot(residual_px[used, 0], residual_px[used, 1])
    top = float(np.quantile(length, LARGEST_QUANTILE)) or 1.0
    dots = axes.scatter(pixels[used, 0], pixels[used, 1], c=length, s=5, cmap=SEQUENTIAL, vmin=0.0, vmax=top, linewidths=0, rasterized=True)
    if not used.all():
        axes.scatter(pixels[~used, 0], pixels[~used, 1], marker="x", s=26, c=ORANGE, label="left out")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderpad=0.0)
    figure.colorbar(dots, ax=axes, label="residual (px)", extend="max")
    axes.set(xlim=(-0.5, width_px - 0.5), ylim=(height_px - 0.5, -0.5), xlabel="u (px)", ylabel="v (px)")
    axes.set_aspect("equal", adjustable="box")
    axes.spines[["top", "right"]].set_visible(True)
    axes.tick_params(color=FAINT, labelcolor=INK)
    return figure


def _short(name: str) -> str:
    return name if len(name) <= MOST_LETTERS else "…" + name[1 - MOST_LETTERS :]
