"""What can go wrong, as one small tree.

    DishmapError            every error this program raises on purpose; the command line prints it and exits with 2
    +-- InputError          a file, an image or a number given by the user cannot be used
    |   +-- CameraError     a camera that is impossible, or does not fit the photograph
    |   +-- PatternError    a pattern file that is impossible or breaks the schema
    |   +-- ImageError      a photograph that cannot be read or holds no usable picture
    +-- MeasurementError    the input is sound but the measurement cannot be made from it
        +-- IdentityError   the printed pattern was not found, or could sit in more than one way
        +-- FitError        a fit did not converge or had too few points

Each message says what was given, what is needed and what to do, in one sentence or two.
"""

from __future__ import annotations


class DishmapError(Exception):
    """Base of all errors that dishmap raises on purpose."""


class InputError(DishmapError):
    """A file, an image or a number given by the user cannot be used."""


class CameraError(InputError):
    """A camera that is impossible, or does not fit the photograph."""


class PatternError(InputError):
    """A pattern that is impossible or breaks the schema."""


class ImageError(InputError):
    """A photograph that cannot be read or holds no usable picture."""


class MeasurementError(DishmapError):
    """The input is sound, but the measurement cannot be made from it."""


class IdentityError(MeasurementError):
    """The printed pattern was not found in the image, or could sit there in more than one way."""


class FitError(MeasurementError):
    """A fit did not converge, or had too few points."""
