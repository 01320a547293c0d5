"""What a user may say, and what is refused in one sentence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dishmap.difference.priors import Priors
from dishmap.errors import InputError


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"amplitude_mm": 0.0}, "smoothness amplitude must lie between"),
        ({"length_mm": -5.0}, "smoothness length must lie between"),
        ({"focal_drift": 0.5}, "focal drift must lie between"),
        ({"strain": "stiff"}, "strain must be rigid, free or a standard deviation"),
        ({"strain": 2.0}, "strain must lie between"),
        ({"slide": "sideways"}, "unknown slide 'sideways'; use one of least_strain"),
        ({"expansion_ppm": (1e6, 1.0)}, "mean expansion must lie within"),
        ({"expansion_ppm": (0.0, -1.0)}, "standard deviation of the expansion must lie"),
        ({"still": True, "length_mm": 10.0}, "only moves as a rigid body has no smoothness"),
    ],
)
def test_impossible_priors_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Priors(**given)


@given(value=st.floats(allow_nan=True, allow_infinity=True))
def test_any_number_is_taken_or_refused(value: float) -> None:
    try:
        kept = Priors(amplitude_mm=value)
    except InputError:
        assert not (np.isfinite(value) and 0 < value <= 1e4)
    else:
        assert kept.amplitude_mm == value
