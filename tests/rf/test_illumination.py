"""Illumination held as designed: what is missing costs, what is won does not count, what is lost is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dishmap.errors import InputError
from dishmap.rf.correction import shape_terms
from dishmap.rf.deformation import undeformed
from dishmap.rf.illumination import MISSING_DB, PRICE, ROUND_DB, held_as_designed
from dishmap.rf.sources import illuminated, search_nodes
from dishmap.rf.surrogate import Traced, tracer
from tests.rf.dishes import SHAPED

# what the rounding of missing light leaves at the design: MISSING_DB ln(1 + exp(-8))
ROUNDED_DB = 1e-5


def design() -> Traced:
    flat = undeformed(SHAPED.reflector)
    return tracer(SHAPED, illuminated(SHAPED, flat, search_nodes(SHAPED, flat, 10.0)))(np.zeros(5 + len(shape_terms(SHAPED.actuators))))


def counted_db(factor) -> float:
    """By how many dB the sum of moments counts more, of a design whose moments became `factor` times as large."""
    still = design()
    held = held_as_designed(
        lambda values, near=None: replace(still, moment=still.moment * factor[:, None]), still.moment, len(still.moment)
    )
    now = held(still.values).moment
    return float(20 * np.log10(abs(now[:, 0].sum()) / abs(still.moment[:, 0].sum())))


def test_the_design_counts_as_it_is() -> None:
    assert abs(counted_db(np.ones(len(design().moment)))) < ROUNDED_DB


@pytest.mark.parametrize("change_db", [-1.0, -0.3, 0.3, 1.0])
def test_light_that_is_missing_costs_itself_and_light_that_is_won_does_not_count(change_db: float) -> None:
    counted = counted_db(np.full(len(design().moment), 10 ** (change_db / 20)))
    price = PRICE * (np.hypot(change_db, ROUND_DB) - ROUND_DB)
    # the rounded corner begins eight of its widths below zero
    assert counted == pytest.approx(min(change_db, 0.0) - price, abs=9 * MISSING_DB)


def test_places_where_rays_are_lost_or_light_changes_many_times_over_are_refused() -> None:
    factor = np.ones(len(design().moment))
    factor[7] = 0.0
    with pytest.raises(InputError, match="rays are lost"):
        counted_db(factor)
    factor[7] = 3.0
    with pytest.raises(InputError, match="more than 6 dB"):
        counted_db(factor)
