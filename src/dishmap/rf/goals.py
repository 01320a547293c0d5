"""What a beam is wanted to be: steered, broadened, or within a mask; each as a smooth cost of the gains towards some directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError

Array = NDArray[np.float64]

# Directions over a broadened disc: rings, and so many on the outermost one.
RINGS, AROUND = 4, 16


@dataclass(frozen=True)
class Steer:
    """The largest gain towards direction cosines u, v."""

    u: float
    v: float

    @staticmethod
    def degrees(theta_deg: float, phi_deg: float) -> Steer:
        """Towards an angle from the boresight, at an azimuth."""
        theta, phi = np.radians(theta_deg), np.radians(phi_deg)
        return Steer(float(np.sin(theta) * np.cos(phi)), float(np.sin(theta) * np.sin(phi)))


@dataclass(frozen=True)
class Broaden:
    """The largest possible lowest gain over a disc of this radius about the boresight."""

    radius_deg: float


@dataclass(frozen=True)
class Mask:
    """Bounds on the gain towards directions uv (D, 2): lowest_db and highest_db (D,), -inf and inf where there is none.

    In dBi, or where `relative`, relative to the gain at the boresight.
    """

    uv: Array
    lowest_db: Array
    highest_db: Array
    relative: bool = False


Goal = Steer | Broaden | Mask


def directions(goal: Goal, reach: float) -> Array:
    """Directions (D, 2) that a goal looks at; a relative mask ends with the boresight.

    Raises InputError for a goal beyond +-reach, or that contradicts itself.
    """
    if isinstance(goal, Steer):
        uv = np.array([[goal.u, goal.v]])
    elif isinstance(goal, Broaden):
        if not 0 < goal.radius_deg < 90:
            raise InputError(f"the radius of a broadened beam must lie between 0 and 90 degrees, not {goal.radius_deg:g}")
        uv = _disc(float(np.sin(np.radians(goal.radius_deg))))
    else:
        uv = _checked(goal)
    if not (np.hypot(*uv.T) <= reach).all():
        asked, most = (float(np.degrees(np.arcsin(min(s, 1.0)))) for s in (np.hypot(*uv.T).max(), reach))
        raise InputError(
            f"the goal reaches {asked:.3g} degrees from the boresight, but the actuators shape beams within {most:.3g} degrees "
            "(five times wavelength over diameter); ask for less, or a lower frequency"
        )
    return uv


def cost(goal: Goal, gains_db: Array, smooth_db: float) -> tuple[float, Array, Array]:
    """What is minimised, with slope (D,) and second derivatives (D, D), for gains (D,) towards a goal's directions.

    A lowest gain is a smooth one, within smooth_db * ln(D) of the true one; a mask costs the sum of squares of what breaks it.
    """
    count = len(gains_db)
    if not isinstance(goal, Mask):
        low = gains_db.min()
        share = np.exp(-(gains_db - low) / smooth_db)
        total = share.sum()
        share = share / total
        return float(smooth_db * np.log(total) - low), -share, (np.diag(share) - np.outer(share, share)) / smooth_db
    turn = np.eye(count)[: len(goal.uv)]
    if goal.relative:
        turn = turn - np.eye(count)[-1]
    excess = broken(goal, gains_db)
    hit = (excess != 0).astype(float)
    return float((excess**2).sum()), 2 * turn.T @ excess, 2 * turn.T @ (hit[:, None] * turn)


def broken(goal: Mask, gains_db: Array) -> Array:
    """By how many dB (D,) gains exceed a mask (positive) or fall short of it (negative)."""
    level = gains_db[: len(goal.uv)] - (gains_db[-1] if goal.relative else 0.0)
    return np.asarray(np.maximum(level - goal.highest_db, 0.0) - np.maximum(goal.lowest_db - level, 0.0))


def figure(goal: Goal, gains_db: Array) -> float:
    """The goal's own figure: gain towards the direction, lowest gain over the disc, or minus the worst violation, all in dB."""
    return -float(np.abs(broken(goal, gains_db)).max()) if isinstance(goal, Mask) else float(gains_db.min())


def _disc(radius: float) -> Array:
    rows = [np.zeros((1, 2))]
    for ring in range(1, RINGS + 1):
        phi = 2 * np.pi * np.arange(AROUND * ring // RINGS) / (AROUND * ring // RINGS)
        rows.append(radius * ring / RINGS * np.stack([np.cos(phi), np.sin(phi)], axis=1))
    return np.concatenate(rows)


def _checked(goal: Mask) -> Array:
    uv = np.asarray(goal.uv, dtype=float)
    if uv.ndim != 2 or uv.shape[1:] != (2,) or not len(uv) or not (len(uv) == len(goal.lowest_db) == len(goal.highest_db)):
        raise InputError("a mask needs directions (D, 2) and as many lowest and highest gains, one at least")
    if not np.isfinite(uv).all() or not (goal.lowest_db <= goal.highest_db).all():
        raise InputError("a mask needs finite directions, and lowest gains that are not above the highest ones")
    return np.concatenate([uv, np.zeros((1, 2))]) if goal.relative else uv
