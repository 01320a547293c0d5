"""How every chart looks, and how it becomes SVG text that is the same for the same numbers.

Only matplotlib's objects are used, no pyplot, so that nothing stays behind in the caller's program; a user's own matplotlibrc
does not change the charts. Colours are those of Okabe and Ito and of viridis, which the colour-blind tell apart.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable
from typing import Any, Literal, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
P = ParamSpec("P")

BLUE, ORANGE, RED, INK, FAINT = "#0072b2", "#d55e00", "#b2182b", "#1a1a1a", "#8a8a8a"
SEQUENTIAL, DIVERGING = "viridis", "RdBu_r"
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "dishmap",
    "svg.fonttype": "path",
    "font.size": 11.0,
    "axes.edgecolor": "#666666",
    "axes.labelcolor": INK,
    "text.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
}
# Dots in 3D: the usual size, up to so many of them, and the least.
DOT, ROOMY_COUNT, SMALLEST_DOT = 4.5, 200, 1.5
# Colours go by the logarithm where values span more than this factor.
LOG_SPAN = 4.0


def as_svg(draw: Callable[P, Figure]) -> Callable[P, str]:
    """Make a function that draws a figure return it as SVG text, drawn in this project's style whatever the user's is."""

    @functools.wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> str:
        with matplotlib.rc_context():
            matplotlib.rcdefaults()
            matplotlib.rcParams.update(STYLE)
            out = io.StringIO()
            draw(*args, **kwargs).savefig(out, format="svg", metadata={"Date": None, "Creator": None})
        # the XML prologue and the DOCTYPE name an address on the network, and a page needs neither
        return re.sub(r"^.*?(?=<svg)", "", out.getvalue(), count=1, flags=re.DOTALL)

    return wrapped


def new_figure(width_in: float, height_in: float, layout: Literal["constrained", "compressed"] = "constrained") -> tuple[Figure, Axes]:
    """A figure with one pair of axes, laid out so that no label is cut; `compressed` suits axes of fixed aspect."""
    figure = Figure(figsize=(width_in, height_in), layout=layout)
    return figure, figure.subplots()


def color_norm(values: ArrayLike) -> Normalize:
    """Scale of colours for positive values: linear, or logarithmic where they span more than LOG_SPAN."""
    good = np.asarray(values, dtype=float)
    good = good[np.isfinite(good)]
    low, high = (float(good.min()), float(good.max())) if good.size else (0.0, 1.0)
    if high - low <= 1e-9 * max(abs(high), abs(low)):
        half = 0.1 * abs(high) or 1.0
        low, high = low - half, high + half
    return LogNorm(low, high) if low > 0 and high > LOG_SPAN * low else Normalize(low, high)


def hex_colors(values: ArrayLike, norm: Normalize) -> list[str]:
    """Colours `#rrggbb` of values (N,) on the sequential scale."""
    rgb = matplotlib.colormaps[SEQUENTIAL](norm(np.asarray(values, dtype=float)), bytes=True)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b, _ in np.atleast_2d(rgb).tolist()]


def dot_size(count: int) -> float:
    """Size of the dots of so many targets in a 3D picture: smaller where they would hide each other."""
    return round(float(np.clip(DOT * np.sqrt(ROOMY_COUNT / max(count, 1)), SMALLEST_DOT, DOT)), 2)


def round_length(length: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten that is not longer than `length` > 0."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= length * (1 + 1e-9)) * power)
