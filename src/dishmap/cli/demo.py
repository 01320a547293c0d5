"""`dishmap demo`: from photographs of a simulated dish to its corrected gain, with the truth beside what is claimed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dishmap.cli.demo_gain import ANTENNA, CHANGE, FREQUENCIES_GHZ, GAIN, deformed, demo_antenna, show_gain
from dishmap.cli.outcome import print_summary, write_outcome
from dishmap.cli.simulate import CAMERA, PATTERN, TRUTH
from dishmap.cli.terminal import progress, say, table

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from dishmap.pipeline import Map
    from dishmap.simulate.scene import Scene
    from dishmap.simulate.truth import Truth

    Array = NDArray[np.float64]

PHOTOGRAPH, LATER, MEASUREMENT = "photograph.png", "later.png", "measurement.npz"
SEED = 1
# 95 of 100 values lie within so many sigmas.
WITHIN = 1.96


@click.command("demo")
@click.option(
    "--out", type=click.Path(path_type=Path), default="demo", show_default=True, metavar="DIR", help="Folder for photograph and results."
)
def demo_command(out: Path) -> None:
    """Photograph a simulated 0.6 m dish (4608x3456 px), map it, and compare with the truth.

    Then deform it, photograph it again, say what changed, what that costs in gain and what moving the subreflector wins back.
    """
    import numpy as np

    from dishmap.io.antenna_file import format_antenna
    from dishmap.io.atomic import output_folder, write_files
    from dishmap.io.camera_file import camera_text, read_camera
    from dishmap.io.images import read_gray
    from dishmap.io.pattern_file import format_pattern, read_pattern
    from dishmap.io.picture_file import picture_bytes
    from dishmap.io.results import Provenance
    from dishmap.io.truth_file import format_truth
    from dishmap.pipeline import map_photograph
    from dishmap.simulate.render import simulate

    scene = demo_scene()
    with output_folder(out):
        say(f"photographing a simulated dish with {len(scene.pattern)} targets, twice: as built, and deformed ...")
        later = deformed(scene)
        shot, again = (simulate(one, np.random.default_rng(seed)) for one, seed in ((scene, SEED), (later, SEED + 1)))
        files: dict[str, str | bytes] = {
            PHOTOGRAPH: picture_bytes(shot.image),
            CAMERA: camera_text(scene.camera),
            PATTERN: format_pattern(scene.pattern),
            LATER: picture_bytes(again.image),
            TRUTH: format_truth([(PHOTOGRAPH, shot.truth), (LATER, again.truth)]),
            ANTENNA: format_antenna(demo_antenna()),
        }
        write_files(out, files)
        # from here on as `dishmap map` does, from the files
        camera, pattern, image = read_camera(out / CAMERA), read_pattern(out / PATTERN), read_gray(out / PHOTOGRAPH)
        begin = time.perf_counter()
        with progress("measuring") as tell:
            result = map_photograph(image, camera, pattern, progress=tell)
        inputs = {"photograph": out / PHOTOGRAPH, "camera": out / CAMERA, "pattern": out / PATTERN}
        provenance = Provenance(camera, inputs, seconds={"map": time.perf_counter() - begin})
        write_outcome(out, result, image, "demo: a simulated 0.6 m dish", provenance)
    print_summary(result, str(out / PHOTOGRAPH), out)
    say()
    say(comparison(result, shot.truth))
    say()
    files_of = {"reference": out / PHOTOGRAPH, "camera": out / CAMERA, "pattern": out / PATTERN}
    show_gain(result, later, out / LATER, files_of, out)
    say()
    _same_again(out)


def _same_again(out: Path) -> None:
    """The commands that do the same on the files of the demo."""
    photo, later, antenna, change, gain = (out / name for name in (PHOTOGRAPH, LATER, ANTENNA, CHANGE, GAIN))
    words = f"--camera {out / CAMERA} --pattern {out / PATTERN}"
    say(f"the same again: dishmap map {photo} {words} --out {out}")
    say(f"                dishmap diff {out / MEASUREMENT} {later} {words} --out {change}")
    frequencies = " ".join(f"{frequency:g}" for frequency in FREQUENCIES_GHZ)
    say(f"                dishmap rf {change} --antenna {antenna} --frequency-ghz {frequencies} --correct --out {gain}")


def demo_scene() -> Scene:
    """A 0.6 m dish of f/D 0.5, 665 mm in front of a 16-megapixel camera with a wide lens, tilted, in uneven light, with clutter."""
    import numpy as np

    from dishmap.camera.model import Camera
    from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose, random_shapes
    from dishmap.targets.builders import dish

    lens = np.array([-0.21, 0.07, 0.0006, -0.0004, -0.009])
    camera = Camera(4608, 3456, np.array([3350.0, 3352.0]), np.array([2310.0, 1721.0]), lens)
    return Scene(
        pattern=dish(600.0, 300.0, 45.0, orientation_marks=True),
        camera=camera,
        camera_from_dish=facing_pose(665.0, np.radians(3.0), np.radians(30.0)),
        light=Light(ink_grey=25, ground_grey=190, background_grey=12, gradient=(0.08, -0.05), vignetting=0.15),
        sensor=Sensor(psf_sigma_px=0.8, noise_grey=1.5, electrons_per_grey=150.0),
        background=random_shapes(np.random.default_rng(SEED), camera, 10, 10, 10, (10.0, 80.0), (20.0, 200.0)),
    )


def comparison(result: Map, truth: Truth) -> str:
    """A table of errors against truth beside the sigmas claimed, rms over the targets, and how many lie within 1.96 sigma."""
    import numpy as np

    from dishmap.transforms import angle_between_rad

    cloud = result.cloud
    place = {int(ident): row for row, ident in enumerate(truth.ids)}
    row = np.array([place[int(ident)] for ident in cloud.ids])
    error_mm = cloud.position_mm - truth.center_mm[row]
    sigma_mm = np.sqrt(np.diagonal(cloud.covariance_mm2, axis1=1, axis2=2))
    error_px = cloud.center_px - truth.center_px[row]
    sigma_px = np.sqrt(np.diagonal(cloud.covariance_px2, axis1=1, axis2=2))
    turn = np.degrees(angle_between_rad(cloud.normal, truth.normal[row]))
    rows = [_row(f"{name} mm", error_mm[:, k], sigma_mm[:, k]) for k, name in enumerate(("x", "y", "z (depth)"))]
    rows += [_row(f"{name} px", error_px[:, k], sigma_px[:, k]) for k, name in enumerate("uv")]
    rows.append(["normal deg", f"{_rms(turn):.4f}", f"{_rms(np.degrees(cloud.sigma_normal_rad)):.4f}", ""])
    return f"against the truth ({len(cloud)} targets):\n" + table(["", "rms error", "claimed sigma", "within 1.96 sigma"], rows)


def _row(name: str, error: Array, sigma: Array) -> list[str]:
    inside = float((abs(error) <= WITHIN * sigma).mean())
    return [name, f"{_rms(error):.4f}", f"{_rms(sigma):.4f}", f"{inside:.0%}"]


def _rms(values: Array) -> float:
    return float((values**2).mean()) ** 0.5
