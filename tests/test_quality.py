"""The table of quality bits: one meaning for each, and names that can be told apart."""

from __future__ import annotations

import numpy as np
import pytest

from dishmap.quality import MEANING, REJECTED, Quality, is_rejected, names


def test_every_bit_has_one_meaning_and_nothing_else_does() -> None:
    bits = [flag for flag in Quality if flag]
    assert set(MEANING) == set(bits)
    assert len(set(MEANING.values())) == len(bits)
    assert all(int(flag).bit_count() == 1 for flag in bits)
    # powers of two without a gap: a bit of a file that is out of the table can be seen as such
    assert sum(int(flag) for flag in bits) == 2 ** len(bits) - 1


@pytest.mark.parametrize(
    ("bits", "text"),
    [
        (0, ""),
        (Quality.CLEAN, ""),
        (Quality.GLARE, "glare"),
        (Quality.CLIPPED | Quality.TOO_SMALL, "clipped|too_small"),
        (int(Quality.OFF_SURFACE | Quality.OCCLUDED), "occluded|off_surface"),
    ],
)
def test_names(bits: int, text: str) -> None:
    assert names(bits) == text


def test_names_are_all_different_and_lead_back() -> None:
    flags = [flag for flag in Quality if flag]
    assert [Quality[names(flag).upper()] for flag in flags] == flags
    together = sum(int(flag) for flag in flags)
    assert names(together).split("|") == [names(flag) for flag in flags]


def test_names_of_numpy_integers() -> None:
    assert [names(bits) for bits in np.array([0, 4, 6], dtype=np.int64)] == ["", "glare", "occluded|glare"]


def test_rejected_are_those_with_a_bit_that_rejects() -> None:
    assert {flag for flag in Quality if flag & REJECTED} == {
        Quality.CLIPPED,
        Quality.NOT_CONVERGED,
        Quality.NO_CONTRAST,
    }
    bits = np.array([0, Quality.GLARE, Quality.CLIPPED, Quality.GLARE | Quality.OFF_SURFACE, Quality.WEAK_DEPTH | Quality.TOO_SMALL])
    assert is_rejected(bits).tolist() == [False, False, True, False, False]
    assert is_rejected(np.zeros(0, dtype=np.int64)).shape == (0,)
