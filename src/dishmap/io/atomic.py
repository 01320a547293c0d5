"""Output that is either whole or not there: written under a temporary name in the same folder, then renamed.

An error or Ctrl-C leaves the old file, if there was one, as it was, and no temporary file behind.
"""

from __future__ import annotations

import itertools
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from dishmap.errors import InputError

# Names may have 255 bytes, up to 4 to a letter; the temporary one adds a dot, process and count to what is kept of the file's own.
KEPT_OF_NAME = 50
_count = itertools.count()


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8 to `path`, all of it or nothing. Raises InputError when that cannot be done."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path`, all of it or nothing. Raises InputError when that cannot be done."""
    path = Path(path)
    write_files(path.parent, {path.name: data})


def write_files(folder: str | Path, files: Mapping[str, str | bytes]) -> None:
    """Write several files (name: text or bytes) into an existing folder, all of them or none.

    All are first written under temporary names and only then renamed, so that a full disk or Ctrl-C leaves no mixture
    of old and new results. Raises InputError when one cannot be written.
    """
    pairs: list[tuple[Path, Path]] = []
    try:
        for name, content in files.items():
            path = Path(folder) / name
            data = content.encode() if isinstance(content, str) else content
            with _as_input_error(path):
                _stage(path, data, pairs)
        for temporary, target in pairs:
            with _as_input_error(target):
                os.replace(temporary, target)
    except BaseException:  # Ctrl-C too
        for temporary, _ in pairs:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        raise


def check_target(path: str | Path) -> None:
    """Raise InputError, before long work begins, when a folder or a read-only file is where `path` is to be written."""
    with _as_input_error(Path(path)):
        _target(Path(path))


def _target(path: Path) -> Path:
    """The file that `path` leads to, which may be written as far as can be seen."""
    target = Path(os.path.realpath(path))  # a link stays a link
    if not path.name or target.is_dir():
        raise IsADirectoryError(None, "it is a folder, and a file is to be written")
    if target.is_file() and not os.access(target, os.W_OK):
        raise PermissionError(None, "the file there is read-only")
    return target


def _stage(path: Path, data: bytes, pairs: list[tuple[Path, Path]]) -> None:
    """Write `data` beside `path` and note the pair, or straight into a device or pipe, which cannot be replaced."""
    target = _target(path)
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        target.write_bytes(data)
        return
    temporary = target.parent / f".{target.name[:KEPT_OF_NAME]}.{os.getpid()}-{next(_count)}.part"
    pairs.append((temporary, target))
    with temporary.open("xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def output_folder(path: str | Path) -> Iterator[Path]:
    """Make `path` (with its parents) and check that files can be written there, before long work begins.

    Folders that were made are removed again if the block fails and they are still empty. Raises InputError when the
    folder cannot be made or written to.
    """
    folder = Path(path)
    missing = [p for p in (folder, *folder.parents) if not os.path.lexists(p)]
    try:
        with _as_input_error(folder):
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".dishmap.{os.getpid()}-{next(_count)}.part"
            try:
                probe.touch(exist_ok=False)
            finally:
                probe.unlink(missing_ok=True)
        yield folder
    except BaseException:
        for made in missing:  # innermost first
            with suppress(OSError, ValueError):
                made.rmdir()
        raise


@contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    """Turn an OSError into one sentence that says what to do."""
    try:
        yield
    except FileExistsError as error:
        raise InputError(f"cannot write to {path}: a file of that name stands in the way; give another folder") from error
    except OSError as error:
        raise InputError(f"cannot write {path}: {_reason(error)}; give a place that can be written to") from error
    except ValueError as error:  # a NUL in the name
        raise InputError(f"cannot write {str(path)!r}: {error}; give another name") from error


def _reason(error: OSError) -> str:
    text = error.strerror or str(error)
    return text[:1].lower() + text[1:]
