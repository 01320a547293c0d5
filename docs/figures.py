"""Draw the pictures of the pages in docs/: `.venv/bin/python docs/figures.py`. They are kept beside the pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dishmap.camera.model import Camera
from dishmap.difference.difference_map import DifferenceMap, joint_difference
from dishmap.pipeline import map_photograph
from dishmap.plot.canvas import BLUE, DIVERGING, FAINT, INK, ORANGE, SEQUENTIAL, as_svg
from dishmap.simulate.deform import Bump, Deformation, ZernikeTerm
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.targets.builders import dish
from dishmap.targets.identify import PoseGuess
from dishmap.targets.pose import TargetPoses
from dishmap.transforms import Pose

Array = NDArray[Any]

HERE = Path(__file__).parent
# Drawn far larger than any real expansion, to be seen.
GROWTH = 1.3
# Of the drawn paraboloid and its camera, mm.
RIM_MM, FOCAL_MM, VERTEX_MM, IMAGE_MM = 300.0, 300.0, 560.0, 110.0


def side_view() -> Array:
    """Points (K, 2) of a dish seen from the side: distance along the axis from the camera, height."""
    height = np.linspace(-RIM_MM, RIM_MM, 9)
    return np.stack([VERTEX_MM - height**2 / (4 * FOCAL_MM), height], axis=1)


def smooth(points: Array) -> Array:
    """A parabola through points (K, 2) that lie on one."""
    height = np.linspace(points[0, 1], points[-1, 1], 100)
    return np.stack([np.polyval(np.polyfit(points[:, 1], points[:, 0], 2), height), height], axis=1)


@as_svg
def scaling() -> Figure:
    """Two dishes of which a camera takes the same photograph."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    side, image = figure.subplots(1, 2, width_ratios=[3.2, 1.0])
    near = side_view()
    for points, color, name in ((near, BLUE, "a dish"), (GROWTH * near, ORANGE, "a larger one, farther away")):
        side.plot(*smooth(points).T, color=color, lw=2.5)
        side.plot(*points.T, "o", color=color, ms=7)
        side.annotate(name, points[-1], xytext=(-8, 4), textcoords="offset points", color=color, ha="right", va="bottom")
    for far in GROWTH * near:
        side.plot([0, far[0]], [0, far[1]], color=FAINT, lw=0.8, zorder=0)
    side.plot([IMAGE_MM, IMAGE_MM], [-100, 100], color=INK, lw=2)
    side.plot([0], [0], "s", color=INK, ms=9)
    side.annotate("camera", (0, 0), xytext=(0, -12), textcoords="offset points", ha="center", va="top")
    side.annotate("image", (IMAGE_MM, -100), xytext=(0, -4), textcoords="offset points", ha="center", va="top")
    side.set(xlim=(-60, 800), ylim=(-430, 470), aspect="equal", title="Every ray meets the same target of both dishes")
    side.axis("off")
    _image(image, near, BLUE, 12.0)
    _image(image, GROWTH * near, ORANGE, 6.0)
    image.set(title="their images", xlim=(-1, 1), ylim=(-110, 110))
    image.axis("off")
    return figure


def _image(axes: Axes, points: Array, color: str, size: float) -> None:
    seen = IMAGE_MM * points[:, 1] / points[:, 0]
    axes.plot(np.zeros(len(seen)), seen, "o", color=color, ms=size)


def example() -> DifferenceMap:
    """A simulated dish that bent a little while the camera's mount gave way by half a millimetre."""
    pattern = dish(600.0, 300.0, spacing_mm=52.0)
    camera = Camera(2000, 2000, np.full(2, 1750.0), np.full(2, 999.5))
    pose = facing_pose(660.0, np.radians(2.0))
    later = Pose.from_rotation_vector(np.radians([0.03, -0.04, 0.0]), [0.2, 0.1, 0.4]) @ pose
    bent = Deformation(zernike=(ZernikeTerm(2, 2, 0.12),), bumps=(Bump((90.0, -60.0), 70.0, 0.2),))
    rng, states = np.random.default_rng(1), []
    for at, state in ((pose, Deformation()), (later, bent)):
        scene = Scene(pattern, camera, at, state, sensor=Sensor(0.8, noise_grey=2.5))
        poses = map_photograph(simulate(scene, rng).image, camera, pattern, PoseGuess(pose)).poses
        assert isinstance(poses, TargetPoses)
        states.append(poses)
    return joint_difference(*states, camera, pattern)


@as_svg
def reading(found: DifferenceMap) -> Figure:
    """Displacement, shape and sigma of one difference, seen from the front."""
    figure = Figure(figsize=(10.0, 3.7), layout="constrained")
    panels = (
        ("displacement", found.displacement_mm, DIVERGING),
        ("shape", found.shape_mm, DIVERGING),
        ("sigma of the shape", found.sigma_shape_mm, SEQUENTIAL),
    )
    for axes, (title, values, colors) in zip(figure.subplots(1, 3), panels, strict=True):
        largest = float(np.abs(values).max())
        low = -largest if colors == DIVERGING else 0.0
        shown = axes.scatter(
            *found.nominal_mm[:, :2].T, c=values, cmap=colors, vmin=low, vmax=largest, s=80, edgecolors=FAINT, linewidths=0.5
        )
        axes.set(aspect="equal", title=title, xticks=[], yticks=[])
        axes.axis("off")
        figure.colorbar(shown, ax=axes, label="mm", shrink=0.8)
    return figure


def main() -> None:
    (HERE / "scaling.svg").write_text(scaling(), encoding="utf-8")
    (HERE / "reading.svg").write_text(reading(example()), encoding="utf-8")


if __name__ == "__main__":
    main()
