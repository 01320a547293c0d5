"""The antenna as its maker describes it: reflector, feed, subreflector, what blocks the aperture, and what can be moved.

Everything is in the dish frame: origin at the vertex of the (parent) paraboloid, z along the boresight towards the focus F1 at
(0, 0, focal length). An offset antenna's aperture is a circle whose centre lies at `offset_mm` on the x axis. A subreflector is a
conic of revolution about z with one focus at F1 and the feed's phase centre at the other, F2, which lies `foci_distance_mm` below it.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError

Array = NDArray[np.float64]

FEED_KINDS = ("gaussian", "cosine", "aperture", "cut")
POLARIZATIONS = ("x", "y", "right", "left")
SUBREFLECTOR_KINDS = ("cassegrain", "gregorian")
# A reflector larger than this is a mistake of units.
LARGEST_MM = 1e6
LARGEST_TAPER_DB = 60.0
LARGEST_EXPONENT = 1000.0
LARGEST_STRUTS, LARGEST_TILT_DEG, LARGEST_SHAPE_DEGREE = 12, 30.0, 12


@dataclass(frozen=True)
class Reflector:
    """The main reflector: a paraboloid over a circular aperture.

    diameter_mm: of the aperture; focal_length_mm: of the (parent) paraboloid; offset_mm: of the aperture's centre from the axis, along x.
    Raises InputError for impossible sizes.
    """

    diameter_mm: float
    focal_length_mm: float
    offset_mm: float = 0.0

    def __post_init__(self) -> None:
        _positive("diameter of the reflector", self.diameter_mm)
        _positive("focal length of the reflector", self.focal_length_mm)
        if not abs(self.offset_mm) <= LARGEST_MM:
            raise InputError(f"the offset of the reflector must lie within +-{LARGEST_MM:g} mm, not {self.offset_mm:g}")

    @property
    def center_mm(self) -> Array:
        """Centre (2,) of the aperture."""
        return np.array([self.offset_mm, 0.0])

    @property
    def focus_mm(self) -> Array:
        """The focus F1 (3,)."""
        return np.array([0.0, 0.0, self.focal_length_mm])


@dataclass(frozen=True)
class CutTable:
    """A feed measured or computed elsewhere: Ludwig-3 far field at angles theta (T,) from its axis and azimuths phi (P,).

    theta_deg rises from 0; phi_deg rises within [0, 360). co, cross (P, T): complex fields along Ludwig's x and y, whatever the feed's
    polarisation, on any common scale.
    """

    theta_deg: Array
    phi_deg: Array
    co: NDArray[np.complex128]
    cross: NDArray[np.complex128]


@dataclass(frozen=True)
class Feed:
    """What illuminates the antenna, with its phase centre at the focus that faces it and its axis through the middle of what it sees.

    kind: `gaussian`: edge_taper_db below the axis at the rim's angle, falling with the square of the angle; `cosine`: field
    cos(theta) to the power `exponent`, or to that which gives edge_taper_db at the rim's angle, nothing behind; `aperture`: the field over
    the aperture, space attenuation included, is Gaussian and edge_taper_db below its middle at the rim; `cut`: a table. Tapers are
    positive numbers of dB. All but the table are Huygens sources (no cross-polarisation on their own). polarization: of the antenna's beam,
    `x`, `y`, `right` or `left` (each reflection turns the hand, so at the prime focus the feed itself has the other one). The aperture
    kind is exact for a centred aperture. Raises InputError for what does not go together.
    """

    kind: str = "gaussian"
    edge_taper_db: float | None = None
    exponent: float | None = None
    polarization: str = "x"
    table: CutTable | None = None

    def __post_init__(self) -> None:
        _one_of("feed", self.kind, FEED_KINDS)
        _one_of("polarization", self.polarization, POLARIZATIONS)
        given = [name for name in ("edge_taper_db", "exponent", "table") if getattr(self, name) is not None]
        wanted = {"cut": (["table"],), "cosine": (["edge_taper_db"], ["exponent"])}.get(self.kind, (["edge_taper_db"],))
        if given not in wanted:
            needs = " or ".join(one[0] for one in wanted)
            raise InputError(f"a {self.kind} feed needs {needs} and nothing else, not {' and '.join(given) or 'nothing'}")
        if self.edge_taper_db is not None and not 0 < self.edge_taper_db <= LARGEST_TAPER_DB:
            raise InputError(f"the edge taper must be a positive number of dB up to {LARGEST_TAPER_DB:g}, not {self.edge_taper_db:g}")
        if self.exponent is not None and not 0 < self.exponent <= LARGEST_EXPONENT:
            raise InputError(f"the exponent of a cosine feed must lie between 0 and {LARGEST_EXPONENT:g}, not {self.exponent:g}")


@dataclass(frozen=True)
class Subreflector:
    """A hyperboloid between the focus and the dish (`cassegrain`) or an ellipsoid beyond the focus (`gregorian`).

    magnification M: equivalent focal length over the main one; foci_distance_mm: from F1 down to the feed; diameter_mm: of its rim, or
    None for the one that just reflects the rays to the rim of the main reflector; a smaller one lights a smaller disc of the dish. Raises
    InputError for impossible values.
    """

    kind: str
    foci_distance_mm: float
    magnification: float
    diameter_mm: float | None = None

    def __post_init__(self) -> None:
        _one_of("subreflector", self.kind, SUBREFLECTOR_KINDS)
        _positive("distance between the foci of the subreflector", self.foci_distance_mm)
        if not 1 < self.magnification <= 1000:
            raise InputError(f"the magnification of a subreflector must lie between 1 and 1000, not {self.magnification:g}")
        if self.diameter_mm is not None:
            _positive("diameter of the subreflector", self.diameter_mm)

    @property
    def eccentricity(self) -> float:
        """Of the conic: (M + 1)/(M - 1) for the hyperboloid, (M - 1)/(M + 1) for the ellipsoid (Hannan 1961)."""
        m = self.magnification
        return (m + 1) / (m - 1) if self.kind == "cassegrain" else (m - 1) / (m + 1)


@dataclass(frozen=True)
class Blockage:
    """What stands in front of the aperture, as shadows along the boresight.

    diameter_mm: of a disc about the z axis, or None for the subreflector's own (0 at the prime focus); struts: how many, spread
    evenly, the first at strut_angle_deg from x; strut_width_mm. Raises InputError for impossible values.
    """

    diameter_mm: float | None = None
    struts: int = 0
    strut_width_mm: float = 0.0
    strut_angle_deg: float = 0.0

    def __post_init__(self) -> None:
        if self.diameter_mm is not None and not 0 <= self.diameter_mm <= LARGEST_MM:
            raise InputError(f"the blocked diameter must lie between 0 and {LARGEST_MM:g} mm, not {self.diameter_mm:g}")
        if not 0 <= self.struts <= LARGEST_STRUTS:
            raise InputError(f"there may be 0 to {LARGEST_STRUTS} struts, not {self.struts}")
        if not 0 <= self.strut_width_mm <= LARGEST_MM or (self.struts > 0) != (self.strut_width_mm > 0):
            raise InputError(f"struts need a number and a width in mm, not {self.struts} and {self.strut_width_mm:g}")
        if not math.isfinite(self.strut_angle_deg):
            raise InputError(f"the angle of the struts must be a number of degrees, not {self.strut_angle_deg}")


@dataclass(frozen=True)
class Actuators:
    """How far the subreflector (or, at the prime focus, the feed) can be moved, either way.

    shift_mm (3,): along x, y, z; tilt_deg (2,): about x and y, through the subreflector's vertex or the feed's phase centre;
    shape_degree: highest degree of the Zernike terms (from the second) into which the subreflector can be bent, 0 for a rigid one;
    shape_stroke_mm: farthest that any point of it can be bent along z. Raises InputError for impossible values.
    """

    shift_mm: tuple[float, float, float] = (10.0, 10.0, 10.0)
    tilt_deg: tuple[float, float] = (3.0, 3.0)
    shape_degree: int = 0
    shape_stroke_mm: float = 0.0

    def __post_init__(self) -> None:
        for value in self.shift_mm:
            if not 0 <= value <= LARGEST_MM:
                raise InputError(f"strokes along x, y and z must lie between 0 and {LARGEST_MM:g} mm, not {value:g}")
        for value in self.tilt_deg:
            if not 0 <= value <= LARGEST_TILT_DEG:
                raise InputError(f"tilts about x and y must lie between 0 and {LARGEST_TILT_DEG:g} degrees, not {value:g}")
        if self.shape_degree and not 2 <= self.shape_degree <= LARGEST_SHAPE_DEGREE:
            raise InputError(f"the degree of the subreflector's shape must be 0 or 2 to {LARGEST_SHAPE_DEGREE}, not {self.shape_degree}")
        if not 0 <= self.shape_stroke_mm <= LARGEST_MM or (self.shape_degree > 0) != (self.shape_stroke_mm > 0):
            raise InputError(
                "a subreflector that changes its shape needs shape_degree and shape_stroke_mm, "
                f"not {self.shape_degree} and {self.shape_stroke_mm:g}"
            )


@dataclass(frozen=True)
class Antenna:
    """A reflector antenna; without a subreflector the feed sits at the prime focus. Raises InputError for what does not go together."""

    reflector: Reflector
    feed: Feed
    subreflector: Subreflector | None = None
    blockage: Blockage = field(default_factory=Blockage)
    actuators: Actuators = field(default_factory=Actuators)

    def __post_init__(self) -> None:
        if self.subreflector is None and self.actuators.shape_degree:
            raise InputError("shape_degree needs a subreflector: a feed at the prime focus has no shape to change")
        sub, main = self.subreflector, self.reflector
        for what, value in (("disc", self.blockage.diameter_mm), ("strut", self.blockage.strut_width_mm)):
            if value is not None and value >= main.diameter_mm:
                raise InputError(
                    f"a blocked {what} of {value:g} mm leaves nothing of an aperture of {main.diameter_mm:g} mm; correct one of the two"
                )
        if sub is not None and sub.kind == "cassegrain" and sub_vertex_z_mm(main, sub) <= 0:
            raise InputError(
                f"the subreflector's vertex would lie at z = {sub_vertex_z_mm(main, sub):.4g} mm, behind the vertex of the dish; "
                "a smaller foci_distance_mm moves it towards the focus"
            )
        # the asymptote of the hyperboloid, seen from F1: tan(psi / 2) = sqrt(M), and the rim is seen at tan(psi / 2) = x / (2 f)
        steep = (abs(main.offset_mm) + main.diameter_mm / 2) / (2 * main.focal_length_mm)
        if sub is not None and sub.kind == "cassegrain" and steep**2 >= sub.magnification:
            raise InputError(
                f"no hyperboloid of magnification {sub.magnification:g} reflects rays to the rim of so deep a dish; "
                f"give a magnification over {steep**2:.3g} or a longer focal length"
            )


def sub_vertex_z_mm(reflector: Reflector, subreflector: Subreflector) -> float:
    """Height of the subreflector's vertex on the z axis: c (1 - 1/e) below F1 for the hyperboloid, c (1/e - 1) above it otherwise.

    With 2 c between the foci and a = c / e half the axis, it is a from the middle of the foci, on F1's side.
    """
    c = subreflector.foci_distance_mm / 2
    return reflector.focal_length_mm - c + c / subreflector.eccentricity


def _positive(what: str, value: float) -> None:
    if not 0 < value <= LARGEST_MM:
        raise InputError(f"the {what} must be a positive number of mm up to {LARGEST_MM:g}, not {value:g}")


def _one_of(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        near = difflib.get_close_matches(value, known, n=1, cutoff=0.0)[0]
        raise InputError(f"unknown {what} {value!r}; the nearest is {near!r} (all: {', '.join(known)})")
