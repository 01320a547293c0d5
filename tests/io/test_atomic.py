"""Output is whole or not there, whatever stops it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dishmap.errors import InputError
from dishmap.io import atomic
from dishmap.io.atomic import output_folder, write_bytes, write_files, write_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_writes_text_and_bytes(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "Größe\n")
    write_bytes(tmp_path / "b.bin", b"\0\xff")
    assert (tmp_path / "a.txt").read_bytes() == "Größe\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == b"\0\xff"
    assert names(tmp_path) == ["a.txt", "b.bin"]


def test_replaces_what_was_there_and_keeps_usual_permissions(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    (tmp_path / "plain").touch()
    write_text(target, "old")
    write_text(target, "new")
    assert target.read_text() == "new"
    # a temporary file of the tempfile module would be readable by its owner only
    assert target.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_writes_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_text(tmp_path / "link.txt", "new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_writes_into_a_device_without_replacing_it() -> None:
    before = os.stat("/dev/null")
    write_text("/dev/null", "gone")
    assert os.stat("/dev/null").st_rdev == before.st_rdev


def test_long_names_fit(tmp_path: Path) -> None:
    name = "ü" * 120 + ".txt"  # 244 bytes of the 255 that file systems take
    write_text(tmp_path / name, "x")
    assert names(tmp_path) == [name]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, MemoryError])
def test_an_interruption_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stop: type) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")

    def interrupted(descriptor: int) -> None:
        raise stop

    monkeypatch.setattr(atomic.os, "fsync", interrupted)
    with pytest.raises(stop):
        write_text(target, "new")
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_several_files_or_none(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("old")
    (tmp_path / "summary.json").mkdir()  # cannot be replaced by a file
    with pytest.raises(InputError, match=r"summary\.json"):
        write_files(tmp_path, {"points.csv": "new", "summary.json": "{}"})
    assert (tmp_path / "points.csv").read_text() == "old"
    assert names(tmp_path) == ["points.csv", "summary.json"]
    write_files(tmp_path, {"points.csv": "new", "cloud.ply": b"ply"})
    assert (tmp_path / "points.csv").read_text() == "new"
    assert (tmp_path / "cloud.ply").read_bytes() == b"ply"


def test_a_kill_by_ctrl_c_in_the_middle_leaves_nothing_half_written(tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from dishmap.io import atomic\n"
        "def slow(descriptor):\n"
        "    print('writing', flush=True)\n"
        "    time.sleep(60)\n"
        "atomic.os.fsync = slow\n"
        "with atomic.output_folder(sys.argv[1]) as folder:\n"
        "    atomic.write_text(folder / 'a.txt', 'x' * 100_000)\n"
    )
    folder = tmp_path / "new" / "out"
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    with process.stdout as stream:
        assert stream.readline().strip() == b"writing"
    assert len(names(folder)) == 1
    time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=20) != 0
    # the folders it had made are gone too
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("missing/a.txt", "cannot write .*missing/a.txt: no such file or directory; give a place that can be written to"),
        ("file/a.txt", "not a directory"),
        ("folder", "it is a folder, and a file is to be written"),
        ("a" * 300, "file name too long"),
        ("nul\0.txt", "give another name"),
    ],
)
def test_a_file_that_cannot_be_written(tmp_path: Path, target: str, message: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=message):
        write_text(tmp_path / target, "x")
    assert names(tmp_path) == ["file", "folder"]


def test_a_full_disk_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"cannot write /dev/full: no space left on device"):
        write_text("/dev/full", "x")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="permission denied"):
        write_text(tmp_path / "a.txt", "x")


def test_output_folder_is_made_with_its_parents(tmp_path: Path) -> None:
    with output_folder(tmp_path / "a" / "b") as folder:
        write_text(folder / "x.txt", "x")
    assert names(tmp_path / "a" / "b") == ["x.txt"]
    with output_folder(tmp_path / "a" / "b"):
        pass
    assert names(tmp_path / "a" / "b") == ["x.txt"]


def test_output_folder_goes_again_when_the_work_fails(tmp_path: Path) -> None:
    (tmp_path / "was").mkdir()
    with pytest.raises(RuntimeError), output_folder(tmp_path / "was" / "a" / "b"):
        raise RuntimeError
    assert names(tmp_path / "was") == []

    # what holds files stays
    def work(path: Path) -> None:
        with output_folder(path) as folder:
            write_text(folder / "x.txt", "x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work(tmp_path / "was" / "c")
    assert names(tmp_path / "was" / "c") == ["x.txt"]


@pytest.mark.parametrize(
    ("target", "message"), [("file", "a file of that name stands in the way"), ("file/out", "cannot write"), ("x\0y", "give another name")]
)
def test_output_folder_that_cannot_be(tmp_path: Path, target: str, message: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=message), output_folder(tmp_path / target):
        pytest.fail("the work must not begin")
    assert names(tmp_path) == ["file"]


def test_output_folder_in_a_place_without_writing() -> None:
    with pytest.raises(InputError, match="cannot write /proc/dishmap"), output_folder("/proc/dishmap"):
        pytest.fail("the work must not begin")
