"""TOML files that people write by hand: read strictly, and what is wrong with one said in a sentence."""

from __future__ import annotations

import difflib
import os
import tomllib
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from dishmap.errors import InputError

# Unknown keys and loose types are refused.
STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)
# Such files are written by hand.
LARGEST_FILE_BYTES = 1_000_000

Model = TypeVar("Model", bound=BaseModel)


def toml_text(path: str | os.PathLike[str], what: str) -> str:
    """The text of a file that is to be a `what`. Raises InputError when it cannot be read, is very large or is no text."""
    try:
        if os.path.getsize(path) > LARGEST_FILE_BYTES:
            raise InputError(f"{path} is larger than {LARGEST_FILE_BYTES // 10**6} MB, so it is no {what}")
        return Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no {what}: it is not text in UTF-8") from error
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the {what} {path}: {getattr(error, 'strerror', None) or error}") from error


def toml_content(text: str, source: str) -> dict[str, Any]:
    """What a TOML text holds. Raises InputError when it is none."""
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{source} is not valid TOML: {error}") from error


def checked(content: dict[str, Any], model: type[Model], source: str) -> Model:
    """The content as `model` describes it. Raises InputError that names the place and, for an unknown key, the nearest valid one."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{source}: {_sentence(error, model)}") from error


def _sentence(error: ValidationError, model: type[BaseModel]) -> str:
    """One sentence for the error a user should mend first: a misspelt key before the key it leaves missing."""
    errors = error.errors(include_url=False, include_context=True, include_input=True)
    first = min(errors, key=lambda e: (e["type"] != "extra_forbidden", e["type"] != "missing"))
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{_explain(first, model)}{more}"


def _explain(error: ErrorDetails, model: type[BaseModel]) -> str:
    place, key = _place(error["loc"][:-1]), str(error["loc"][-1])
    if error["type"] == "extra_forbidden":
        fields = list(_model_at(error["loc"], model).model_fields)
        near = difflib.get_close_matches(key, fields, n=1, cutoff=0.0)[0]
        return f"unknown key {key!r} in {place}; the nearest valid one is {near!r} (all: {', '.join(fields)})"
    if error["type"] == "missing":
        return f"{place} lacks the key {key!r}"
    value = repr(error["input"])
    message = error["msg"].replace("Input should be", "must be").replace("List should have", "must have")
    return f"{_place(error['loc'])} {message[0].lower()}{message[1:]}, not {value if len(value) <= 60 else f'{value[:57]}...'}"


def _model_at(loc: tuple[int | str, ...], model: type[BaseModel]) -> type[BaseModel]:
    """The model in which the last part of a location stands, from that of the whole file."""
    for part in loc[:-1]:
        if isinstance(part, str):
            model = _model_in(model.model_fields[part].annotation) or model
    return model


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((found for part in get_args(annotation) if (found := _model_in(part)) is not None), None)


def _place(loc: tuple[int | str, ...]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc).lstrip(".")
    return text or "the file"
