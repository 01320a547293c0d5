"""Scenario files: what they say is what is photographed, and mistakes are named."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from dishmap.errors import CameraError, InputError
from dishmap.io.scenario_file import parse_scenario, read_scenario
from dishmap.io.scenario_pattern import KindName
from dishmap.simulate.scenario import Scenario, State, simulate_states
from dishmap.simulate.scene import Disc, Polygon, Ribs
from dishmap.targets.builders import KIND_BUILDERS
from dishmap.targets.pattern import Surface

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "scenario_dish.toml"

SMALL = """
format = "dishmap-scenario/1"
seed = 5
[pattern]
plate = { rows = 2, columns = 3, pitch_mm = 30, kind = "ring", kind_options = { outer_radius_mm = 6, inner_radius_mm = 4 } }
[camera]
width_px = 320
height_px = 240
focal_px = 500
[pose]
distance_mm = 300
tilt_deg = 20
tilt_direction_deg = 90
[sensor]
noise_grey = 2.0
[clutter]
rings = 2
[[ribs]]
count = 8
width_mm = 12
inner_radius_mm = 50
outer_radius_mm = 70
grey = 60
first_deg = 90
front = false
[[occluders]]
center_px = [10, 20]
radius_px = 5
[[occluders]]
corners_px = [[0, 0], [9, 0], [0, 9]]
grey = 40
[[states]]
name = "ref"
[[states]]
name = "bent"
expansion_ppm = -100
zernike = [{ term = "defocus", size_mm = 0.3 }, { n = 2, m = -2, size_mm = 0.1 }]
bumps = [{ center_mm = [1, 2], sigma_mm = 5, height_mm = 0.2 }]
creases = [{ point_mm = [0, 1], direction_deg = 90, sigma_mm = 5, height_mm = 0.1 }]
gores = [{ count = 6, depth_mm = 0.4 }]
motion = { rotation_vector_deg = [0, 0, 90], translation_mm = [1, 2, 3] }
"""


def test_a_file_becomes_scenes() -> None:
    scenario = parse_scenario(SMALL)
    ref, bent = (state.scene for state in scenario.states)
    assert [state.name for state in scenario.states] == ["ref", "bent"]
    assert (scenario.seed, len(ref.pattern), ref.camera.width_px) == (5, 6, 320)
    assert ref.pattern.kind_of(0).radius_mm.tolist() == [6, 4]
    assert ref.pattern.surface == Surface()
    assert ref.camera.principal_px.tolist() == [159.5, 119.5]
    assert ref.camera.focal_px.tolist() == [500, 500]
    # tilted by 20 degrees about the pattern's y: its right half comes towards the camera or goes away
    assert ref.camera_from_dish.apply([0, 50, 0]) == pytest.approx([0, -50, 300])
    assert abs(ref.camera_from_dish.apply([50, 0, 0])[2] - 300) == pytest.approx(50 * np.sin(np.radians(20)))
    assert ref.sensor.noise_grey == 2.0
    assert len(ref.background) == 4
    assert ref.ribs == (Ribs(8, 12.0, 50.0, 70.0, 60.0, np.pi / 2, front=False),)
    assert ref.occluders == (Disc((10.0, 20.0), 5.0, 0.0), Polygon(((0.0, 0.0), (9.0, 0.0), (0.0, 9.0)), 40.0))
    state = bent.deformation
    assert [(z.n, z.m, z.size_mm) for z in state.zernike] == [(2, 0, 0.3), (2, -2, 0.1)]
    assert state.creases[0].direction_rad == pytest.approx(np.pi / 2)
    assert state.expansion_ppm == -100
    assert state.motion.apply([1, 0, 0]) == pytest.approx([1, 3, 3])
    assert (state.bumps[0].height_mm, state.gores[0].count) == (0.2, 6)
    assert bent.background == ref.background


def test_states_repeat_and_do_not_depend_on_each_other() -> None:
    scenario = parse_scenario(SMALL)
    first = dict(simulate_states(scenario))
    again = dict(simulate_states(parse_scenario(SMALL)))
    assert all((first[name].image == again[name].image).all() for name in ("ref", "bent"))
    assert (dict(simulate_states(parse_scenario(SMALL.replace("seed = 5", "seed = 6"))))["ref"].image != first["ref"].image).any()
    shorter = parse_scenario(SMALL[: SMALL.rindex("[[states]]")])
    assert (dict(simulate_states(shorter))["ref"].image == first["ref"].image).all()
    with pytest.raises(InputError, match="the state 'ref' is given twice"):
        Scenario("s", 1, (scenario.states[0], State("ref", scenario.states[1].scene)))


def test_the_example_is_valid_and_shows_every_key() -> None:
    scenario = read_scenario(EXAMPLE)
    assert [state.name for state in scenario.states] == ["ref", "astigmatism", "cold"]
    assert scenario.states[0].scene.pattern.surface.focal_length_mm == 300
    text = EXAMPLE.read_text()
    # each commented line is valid too
    plate = text.replace("dish = {", "# dish = {").replace("# plate =", "plate =").replace("# glare", "glare")
    for line in ("[[ribs]]", "count = 8", "width_mm", "inner_radius_mm", "outer_radius_mm", "grey = 60", "first_deg", "front = true"):
        plate = plate.replace(f"# {line}", line)
    plate = plate.replace("# [[occ", "[[occ").replace("# corners", "corners").replace("# grey = 40", "grey = 40")
    scene = parse_scenario(plate).states[0].scene
    assert len(scene.pattern) == 30
    assert len(scene.light.glare) == 1
    assert (scene.ribs[0].count, scene.ribs[0].front) == (8, True)
    assert len(scene.occluders) == 1


def test_files_are_found_beside_the_scenario(tmp_path: Path, shared_data: Path) -> None:
    folder = shared_data / "plate"
    path = tmp_path / "scenario.toml"
    path.write_text(f"""
format = "dishmap-scenario/1"
pattern.file = "{folder}/pattern.json"
camera.file = "{folder}/camera.yaml"
pose = {{ rotation_vector_deg = [180, 0, 0], translation_mm = [0, 0, 1000] }}
""")
    scene = read_scenario(path).states[0].scene
    assert len(scene.pattern) == 30
    assert scene.camera.width_px == 2304
    assert scene.camera_from_dish.apply([0, 1, 0]) == pytest.approx([0, -1, 1000])
    path.write_text(path.read_text().replace(f"{folder}/camera.yaml", "missing.yaml"))
    with pytest.raises(CameraError, match=r"missing\.yaml") as caught:
        read_scenario(path)
    assert str(tmp_path) in str(caught.value)


def test_kinds_are_those_of_the_builders() -> None:
    assert set(get_args(KindName)) == set(KIND_BUILDERS)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("noise_grey", "nois_grey", r"unknown key 'nois_grey' in sensor; the nearest valid one is 'noise_grey' \(all: psf_sigma_px"),
        ("expansion_ppm", "expansion_pm", r"unknown key 'expansion_pm' in states\[1\]; the nearest valid one is 'expansion_ppm'"),
        ("[sensor]", "[senzor]", "unknown key 'senzor' in the file; the nearest valid one is 'sensor'"),
        (
            "sigma_mm = 5, height_mm = 0.2",
            "sigma = 5, height_mm = 0.2",
            r"unknown key 'sigma' in states\[1\].bumps\[0\].*'sigma_mm'.*1 more",
        ),
        ("outer_radius_mm", "outer_mm", "unknown option 'outer_mm' of kind 'ring'; the nearest valid one is 'outer_radius_mm'"),
        ("outer_radius_mm = 6", "outer_radius_mm = [6]", "kind_options of 'ring' need numbers"),
        ('kind = "ring"', 'kind = "rings"', "pattern.plate.kind must be 'disc', 'ring'"),
        ("pitch_mm = 30", "pitch_mm = 10", "a pitch of 10 mm is too small"),
        ("rows = 2, ", "", "pattern.plate lacks the key 'rows'"),
        ("plate =", "# plate =", r"\[pattern\] needs one of file, plate, dish and grid, not none"),
        ("[pattern]", "[pattern]\nfile = 'a.json'", r"\[pattern\] needs one of file, plate, dish and grid, not file and plate"),
        ("width_px = 320", "", r"\[camera\] needs either file, or width_px, height_px and focal_px"),
        ("width_px = 320", "file = 'a.yaml'", r"\[camera\] needs either file or the camera's numbers, not both"),
        ("focal_px = 500", "focal_px = -500", "a camera's focal length must be positive"),
        ("distance_mm = 300", "", r"\[pose\] needs either rotation_vector_deg and translation_mm, or distance_mm"),
        ("distance_mm = 300", "translation_mm = [0, 0, 300]", r"\[pose\] needs rotation_vector_deg together with translation_mm"),
        ("distance_mm = 300", "distance_mm = nan", "pose.distance_mm must be a finite number, not nan"),
        ("noise_grey = 2.0", "noise_grey = -2.0", "noise_grey must be zero or more, not -2.0"),
        ("outer_radius_mm = 70", "outer_radius_mm = 40", "ribs run from inner_radius_mm out to outer_radius_mm, not 50.0 to 40.0"),
        ("count = 8", "number = 8", r"unknown key 'number' in ribs\[0\]; the nearest valid one is"),
        ("radius_px = 5", "", "a shape of occluders needs either center_px and radius_px, or corners_px"),
        ("radius_px = 5", "radius_px = true", r"occluders\[0\].radius_px must be a valid number, not True"),
        ('term = "defocus"', 'term = "defokus"', "state 'bent': unknown Zernike term 'defokus'; the nearest name is 'defocus'"),
        ('term = "defocus"', "n = 2", "state 'bent': a Zernike term needs either term, or n and m"),
        ("m = -2", "m = -1", "state 'bent': there is no Zernike term n=2, m=-1"),
        ("count = 6", "count = 1", "state 'bent': gores need a count of at least 2 ribs, not 1"),
        ("expansion_ppm = -100", "expansion_ppm = 1e6", "state 'bent': expansion_ppm must lie within"),
        ('name = "bent"', 'name = "ref"', "the state 'ref' is given twice"),
        ('name = "bent"', 'name = "../x"', r"states\[1\].name string should match pattern"),
        ('name = "bent"', "", r"states\[1\] lacks the key 'name'"),
        ('format = "dishmap-scenario/1"', 'format = "x"', "no scenario file: its first line must be format = 'dishmap-scenario/1'"),
        ("seed = 5", "seed = ", "not valid TOML: .*line 3"),
        ("seed = 5", "seed = -5", "seed must be greater than or equal to 0, not -5"),
    ],
)
def test_mistakes_are_named(old: str, new: str, message: str) -> None:
    assert old in SMALL
    with pytest.raises(InputError, match=f"(?s)^my.toml.*{message}"):
        parse_scenario(SMALL.replace(old, new, 1) if "bent" not in old else SMALL.replace(old, new), source="my.toml")


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the scenario file .*none\.toml"):
        read_scenario(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no scenario file: it is not text in UTF-8"):
        read_scenario(tmp_path / "binary.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * 1_000_001)
    with pytest.raises(InputError, match="larger than 1 MB"):
        read_scenario(tmp_path / "large.toml")


GRID = Path(__file__).resolve().parents[2] / "examples" / "scenario_grid.toml"


def test_a_grid_with_broken_lines() -> None:
    scene = read_scenario(GRID).states[1].scene
    assert scene.pattern.is_grid
    assert scene.pattern.surface == Surface("paraboloid", 300.0, 150.0)
    pieces = sum(len(line.ids) - 1 for line in scene.pattern.lines)
    assert (scene.line_gaps[0].line, scene.line_gaps[0].start_t, scene.line_gaps[0].stop_t) == (3, 4.5, 6.5)
    assert len(scene.line_gaps) == 1 + round(0.15 * pieces)
    # the same file breaks the same lines, in every state
    assert scene.line_gaps == read_scenario(GRID).states[0].scene.line_gaps


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("line_mm = 1.0", "", "give line_mm or square_mm, and not both"),
        ("line_mm = 1.0", "line_width_mm = 1.0", "unknown key 'line_width_mm' in pattern.grid; the nearest valid one is 'line_mm'"),
        ("diameter_mm = 300", "", "the surface 'dish' needs diameter_mm"),
        ('"dish"  ', '"cylinder"  ', "the surface 'cylinder' needs cylinder_radius_mm|diameter_mm is no size of the surface 'cylinder'"),
        ("line = 3", "line = 300", "a gap is in line 300, but the pattern has"),
        ("broken_share = 0.15", "broken_share = 15", "print.broken_share must be less than or equal to 1"),
    ],
)
def test_mistakes_in_a_grid_are_named(old: str, new: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        parse_scenario(GRID.read_text().replace(old, new, 1))
