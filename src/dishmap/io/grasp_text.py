"""Text files of numbers as GRASP writes and reads them: lines of a known sense, then blocks of numbers over any number of lines."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dishmap.errors import InputError

Array = NDArray[np.float64]

LARGEST_FILE_BYTES = 400_000_000
# Fortran leaves the E of a three-digit exponent out, and has D for double precision.
EXPONENT = re.compile(r"(?<=[0-9.])[dD]?(?=[+-]\d)|[dD](?=\d)")


class Lines:
    """The lines of a text, taken one after the other; what is wrong with one is said with its number.

    source: the name of the file in messages.
    """

    def __init__(self, text: str, source: str) -> None:
        self.source = source
        self._lines = text.splitlines()
        self._letters = np.cumsum([0, *(len(line) + 1 for line in self._lines)])
        self._next = 0

    def __bool__(self) -> bool:
        """Whether any line that is not blank is left."""
        return any(line.strip() for line in self._lines[self._next :])

    def finish(self) -> None:
        """Raise InputError when anything but blank lines is left."""
        while self._next < len(self._lines):
            if self.line("").strip():
                raise self.error("more follows than the file announces")

    def error(self, problem: str) -> InputError:
        """The error that the line taken last has this problem."""
        return InputError(f"{self.source}, line {max(self._next, 1)}: {problem}")

    def line(self, what: str) -> str:
        """The next line. Raises InputError when there is none."""
        if self._next >= len(self._lines):
            raise InputError(f"{self.source} ends after {len(self._lines)} lines, where {what} should follow")
        self._next += 1
        return self._lines[self._next - 1]

    def numbers(self, names: str) -> Array:
        """One finite number for each of the names, from the next line; what stands behind them is left alone. Raises InputError."""
        words, count = _words(self.line(names)), len(names.split())
        if len(words) < count:
            raise self.error(f"{names} are needed ({count} numbers), not {' '.join(words)[:60]!r}")
        return self._finite(words[:count])

    def integers(self, names: str) -> list[int]:
        """One whole number for each of the names, from the next line. Raises InputError."""
        values = self.numbers(names)
        if (values != np.round(values)).any() or (np.abs(values) > 2**31).any():
            raise self.error(f"{names} must be whole numbers, not {' '.join(f'{v:g}' for v in values)}")
        return [int(value) for value in values]

    def block(self, count: int, what: str) -> Array:
        """As many finite numbers (count,), from as many whole lines as it takes. Raises InputError."""
        self.fits(count, what)
        start, words = self._next, list[str]()
        while len(words) < count:
            words += _words(self.line(f"{count - len(words)} more of {count} numbers ({what})"))
        if len(words) > count:
            raise self.error(f"{len(words) - count} more numbers than the {count} that are needed ({what})")
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([np.nan])
        if np.isfinite(values).all():
            return values
        # once more line by line: for numbers as Fortran writes them, and for the line of what is wrong
        end, self._next = self._next, start
        return np.concatenate([self._finite(_words(self.line(what))) for _ in range(end - start)])

    def fits(self, count: int, what: str) -> None:
        """Raise InputError at once for so many numbers that the rest of the text, at two characters each, cannot hold them."""
        room = int(self._letters[-1] - self._letters[self._next] + 1) // 2
        if not 0 <= count <= room:
            raise self.error(f"{count} numbers ({what}) are announced, and the rest of the file has room for {room} at most")

    def _finite(self, words: list[str]) -> Array:
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.array([self._number(word) for word in words])
        if not np.isfinite(values).all():
            raise self.error(f"{words[int(np.argmin(np.isfinite(values)))]!r} is no finite number")
        return values

    def _number(self, word: str) -> float:
        try:
            return float(EXPONENT.sub("E", word, count=1))
        except ValueError as error:
            raise self.error(f"{word[:30]!r} is no number") from error


def _words(line: str) -> list[str]:
    return line.replace(",", " ").split()


def grasp_text(path: str | os.PathLike[str], what: str) -> str:
    """The text of a `what` (as in messages); comments in it may have any encoding. Raises InputError when it cannot be read."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no {what}")
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the {what} {path}: {getattr(error, 'strerror', None) or error}") from error
    if b"\0" in data:
        raise InputError(f"{path} is no {what}: it is not text")
    return data.decode("utf-8-sig", errors="replace")


def rows(values: Array) -> list[str]:
    """A line for each row of a table (N, M), 10 decimals after the first digit."""
    pattern = " ".join(["%18.10E"] * values.shape[1])
    return [pattern % tuple(row) for row in values.tolist()]


def one_line(text: str) -> str:
    """A text as it can stand in a line of its own: without line breaks and outer spaces."""
    return " ".join(text.split())


def joined(lines: Iterable[str]) -> str:
    """The text of the lines, each with its end."""
    return "".join(f"{line}\n" for line in lines)
