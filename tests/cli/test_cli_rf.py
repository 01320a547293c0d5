"""`dishmap rf` on a small made-up difference: all its files, its words, its refusals."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_words import dishmap, refused
from click.testing import Result
from differences import DISH, PLATE, joint_of

from dishmap.cli.rf import frequencies_of, goal_of, repeated
from dishmap.difference.saved import saved_difference
from dishmap.errors import InputError
from dishmap.io.antenna_file import format_antenna
from dishmap.io.difference_map_file import write_difference_map
from dishmap.io.grasp_pattern import read_grd
from dishmap.rf.antenna import Actuators, Antenna, Feed, Reflector, Subreflector
from dishmap.rf.goals import Broaden, Mask, Steer
from dishmap.targets.pattern import Pattern

PRIME = Antenna(Reflector(300.0, 150.0), Feed("gaussian", 12.0))
CASSEGRAIN = Antenna(PRIME.reflector, PRIME.feed, Subreflector("cassegrain", 110.0, 4.0))
FREQUENCY_GHZ = 15.0


def difference(folder: Path, pattern: Pattern) -> Path:
    """The folder of a difference of a dish or plate that lost its focus and got a saddle."""
    x, y = pattern.center_mm[:, :2].T / 150.0
    joint = replace(joint_of(pattern), shape_mm=-0.5 * (2 * (x**2 + y**2) - 1) + 0.2 * (x**2 - y**2))
    folder.mkdir()
    write_difference_map(folder / "difference.npz", saved_difference(joint, pattern))
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with differences `change` of a dish and `plate`, and two antennas."""
    folder = tmp_path_factory.mktemp("rf")
    difference(folder / "change", DISH)
    difference(folder / "plate", PLATE)
    for name, antenna in (("prime", PRIME), ("cassegrain", CASSEGRAIN)):
        (folder / f"{name}.toml").write_text(format_antenna(antenna))
    return folder


@pytest.fixture
def short_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report of one line: drawing takes longer than the rest."""
    monkeypatch.setattr("dishmap.rf_report.rf_report", lambda analysis, title, inputs: title)


@pytest.fixture(scope="module")
def corrected(place: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder of a correction, and what the program said."""
    out = tmp_path_factory.mktemp("corrected") / "out"
    done = rf(place, "cassegrain", out, "--correct")
    assert done.exit_code == 0, (done.output, done.exception)
    return out, done


def rf(place: Path, antenna: str, out: Path, *more: object, shape: str = "change", ghz: tuple[float, ...] = (FREQUENCY_GHZ,)) -> Result:
    return dishmap("rf", place / shape, "--antenna", place / f"{antenna}.toml", "--frequency-ghz", *ghz, "--out", out, *more)


def test_all_files_are_there(corrected: tuple[Path, Result]) -> None:
    out, _ = corrected
    patterns = {f"pattern_{state}_15GHz.{kind}" for state in ("design", "measured", "corrected") for kind in ("cut", "grd")}
    tables = {"summary.json", "gain.csv", "modes.csv", "cuts.csv", "rf.nc", "correction.json", "correction.csv"}
    surface = {"surface_deformed.sfc", "points.xyz", "aperture.rim", "surface.tor"}
    assert {path.name for path in out.iterdir()} == {*patterns, *tables, *surface, "report.html"}


def test_figures_agree_everywhere(corrected: tuple[Path, Result]) -> None:
    out, done = corrected
    summary = json.loads((out / "summary.json").read_text())
    with (out / "gain.csv").open() as stream:
        rows = {row["state"]: row for row in csv.DictReader(stream)}
    lost, won = summary["lost"][0]["mean_db"], summary["recovered"]["corrected"][0]["mean_db"]
    gains = {state: float(row["gain_dbi"]) for state, row in rows.items()}
    assert gains["measured"] - gains["design"] == pytest.approx(lost, abs=1e-6)
    assert gains["corrected"] - gains["measured"] == pytest.approx(won, abs=1e-6)
    # the rigid pose takes the defocus, which is most of the loss, and changes spillover and illumination a little
    assert 0.05 < 0.5 * -lost < won
    said = re.search(r"At 15 GHz the change of shape costs ([\d.]+) ± [\d.]+ dB; moving the subreflector wins back ([\d.]+)", done.stdout)
    assert said is not None
    assert [float(one) for one in said.groups()] == pytest.approx([-lost, won], abs=2e-3)
    assert said[0] in (out / "report.html").read_text()
    (grid,) = read_grd(out / "pattern_corrected_15GHz.grd")
    assert 20 * np.log10(np.nanmax(np.abs(grid.co))) == pytest.approx(gains["corrected"], abs=0.05)
    shift = next(one for one in summary["corrections"]["corrected"]["actuators"] if one["name"] == "shift_z")
    assert abs(shift["value"]) > 0.1
    told = re.search(r"shift z +mm +([+-]\d+\.(\d+)) ± ", done.stdout)
    assert told is not None
    assert float(told[1]) == pytest.approx(shift["value"], abs=0.51 * 10 ** -len(told[2]))
    assert summary["inputs"]["shape"]["path"].endswith("difference.npz")


@pytest.mark.usefixtures("short_report")
def test_several_frequencies_as_typed_and_a_target_beam(place: Path, tmp_path: Path) -> None:
    done = rf(place, "prime", tmp_path / "out", "--target-beam", "steer:2,90", "--whole-motion", ghz=(15, 20))
    assert done.exit_code == 0, (done.output, done.exception)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["options"]["frequencies_ghz"] == [15.0, 20.0]
    assert summary["quantity"] == "displacement"
    assert "Target beam at 20 GHz: the gain towards θ 2.00°, φ 90°" in done.stdout
    beam = summary["corrections"]["target beam"]
    assert beam["after_db"] > beam["before_db"]
    assert (tmp_path / "out" / "pattern_target_beam_20GHz.cut").is_file()


@pytest.mark.usefixtures("short_report")
def test_no_correction_stays_of_an_earlier_run(place: Path, tmp_path: Path) -> None:
    (tmp_path / "correction.json").write_text("old")
    assert rf(place, "prime", tmp_path).exit_code == 0
    assert not (tmp_path / "correction.json").exists()


def test_bad_input(place: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    text = (place / "prime.toml").read_text()
    for name, bad, words in (
        ("missing", text.replace("focal_length_mm = 150.0\n", ""), "focal_length_mm"),
        ("unknown", text.replace("offset_mm", "ofset_mm"), "'offset_mm'"),
        ("larger", text.replace("150.0", "250.0"), "focal length"),
        ("small", text.replace("diameter_mm = 300.0", "diameter_mm = 200.0"), "diameter"),
    ):
        (tmp_path / f"{name}.toml").write_text(bad)
        said = refused(dishmap("rf", place / "change", "--antenna", tmp_path / f"{name}.toml", "--frequency-ghz", 15, "--out", out))
        assert words in said
    assert "3 GHz or more" in refused(rf(place, "prime", out, ghz=(1,)))
    assert "plane" in refused(rf(place, "prime", out, shape="plate"))
    assert "holds no difference.npz" in refused(rf(place, "prime", out, shape="."))
    assert "no such file" in refused(rf(place, "prime", out, shape="nowhere"))
    assert "no such file" in refused(rf(place, "nothing", out)).lower()
    assert "steer:THETA,PHI" in refused(rf(place, "prime", out, "--target-beam", "wide"))
    assert "cannot read the mask" in refused(rf(place, "prime", out, "--target-beam", "mask:none.csv"))
    assert "names 15 GHz twice" in refused(rf(place, "prime", out, ghz=(15, 20, 15)))
    assert "beyond 3000 GHz; frequencies are in GHz" in refused(rf(place, "prime", out, ghz=(15, 12500)))
    still = replace(PRIME, actuators=Actuators((0.0, 0.0, 0.0), (0.0, 0.0)))
    (place / "still.toml").write_text(format_antenna(still))
    assert "needs something that moves" in refused(rf(place, "still", out, "--target-beam", "steer:1,0"))
    for option in ("--camera", "--pattern"):
        assert f"{option} is for a map" in refused(rf(place, "prime", out, option, place / "prime.toml"))
    before = sorted(path.name for path in (place / "change").iterdir())
    assert "give another folder" in refused(rf(place, "prime", place / "plate" / ".." / "change"))
    assert sorted(path.name for path in (place / "change").iterdir()) == before
    assert not out.exists()


def test_usage_errors(place: Path, tmp_path: Path) -> None:
    for words in (["--frequency-ghz", "-5"], ["--frequency-ghz", "x"], ["--frequency-ghz"], []):
        done = dishmap("rf", place / "change", "--antenna", place / "prime.toml", "--out", tmp_path / "out", *words)
        assert done.exit_code == 2
        assert "frequency" in done.stderr.lower() or "-5" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("typed", "seen"),
    [
        ("a --frequency-ghz 12.5 30 --out d", "a --frequency-ghz 12.5 --frequency-ghz 30 --out d"),
        ("--frequency-ghz 12.5 30 a", "--frequency-ghz 12.5 --frequency-ghz 30 a"),
        ("--frequency-ghz 12.5,20 30 --frequency-ghz 5 a 7", "--frequency-ghz 12.5,20 --frequency-ghz 30 --frequency-ghz 5 a 7"),
        ("--frequency-ghz=3 a", "--frequency-ghz=3 a"),
        ("--frequency-ghz 3 -- 4", "--frequency-ghz 3 -- 4"),
    ],
)
def test_numbers_after_the_option_are_all_its_own(typed: str, seen: str) -> None:
    assert repeated(typed.split()) == seen.split()


def test_frequencies_of_all_kinds() -> None:
    assert frequencies_of(([12.5, 20.0], [30.0])) == (12.5, 20.0, 30.0)


def test_goals(tmp_path: Path) -> None:
    assert goal_of(None) is None
    steer = goal_of("steer:90e-1,90")
    assert isinstance(steer, Steer)
    assert (steer.u, steer.v) == pytest.approx((0.0, np.sin(np.radians(9.0))))
    assert goal_of("broaden:2") == Broaden(2.0)
    (tmp_path / "mask.csv").write_text("theta_deg,phi_deg,lowest_db,highest_db\n2,0,,-20\n1,90,-5,\n")
    mask = goal_of(f"mask:{tmp_path / 'mask.csv'}")
    assert isinstance(mask, Mask)
    assert (mask.relative, mask.lowest_db.tolist(), mask.highest_db.tolist()) == (True, [-np.inf, -5.0], [-20.0, np.inf])
    for bad in ("steer:1", "steer:95,0", "steer:a,b", "broaden:", "mask:", "spot:1", ""):
        with pytest.raises(InputError, match="is none of steer"):
            goal_of(bad)
