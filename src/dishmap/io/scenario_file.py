"""Scenario files: TOML of the format `dishmap-scenario/1`, which say what `dishmap simulate` photographs.

The models below and those of `scenario_pattern` are the format; `examples/scenario_dish.toml` and `examples/scenario_grid.toml` show
all of it. Angles are in degrees, files are found
relative to the scenario's own folder.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field

from dishmap.camera.model import Camera
from dishmap.errors import InputError
from dishmap.io.camera_file import read_camera
from dishmap.io.scenario_pattern import PatternSource, pattern_of
from dishmap.io.toml_file import STRICT, checked, toml_content, toml_text
from dishmap.simulate.deform import Bump, Crease, Deformation, Gores, ZernikeTerm
from dishmap.simulate.scenario import Scenario, State
from dishmap.simulate.scene import (
    Disc,
    Glare,
    Light,
    LineGap,
    Polygon,
    Ribs,
    Scene,
    Sensor,
    Shape,
    facing_pose,
    random_line_gaps,
    random_shapes,
)
from dishmap.surface.zernike import parse_term
from dishmap.targets.pattern import Pattern
from dishmap.transforms import Pose

FORMAT = "dishmap-scenario/1"
# Names of states become names of files.
NAME = r"^[A-Za-z0-9][A-Za-z0-9._+-]{0,99}$"

Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
# States take the streams [seed, 0], [seed, 1] and so on; this one is far beyond them.
BROKEN_STREAM = 2**31


class _Model(BaseModel):
    model_config = STRICT


class CameraSource(_Model):
    """A camera file, or the camera's numbers; without principal_px the middle of the image."""

    file: str | None = None
    width_px: int | None = None
    height_px: int | None = None
    focal_px: float | Pair | None = None
    principal_px: Pair | None = None
    distortion: list[float] = []
    model: Literal["opencv", "fisheye"] = "opencv"


class PoseModel(_Model):
    """camera_from_dish in full, or a camera that looks at the vertex from a distance, with the dish tilted."""

    rotation_vector_deg: Triple | None = None
    translation_mm: Triple | None = None
    distance_mm: Annotated[float, Field(gt=0)] | None = None
    tilt_deg: float = 0.0
    tilt_direction_deg: float = 0.0


class GlareModel(_Model):
    """A bright spot."""

    center_px: Pair
    sigma_px: float
    peak_grey: float


class LightModel(_Model):
    """Grey levels (0 to 255) and shading, as `dishmap.simulate.scene.Light`."""

    ink_grey: float = Light.ink_grey
    ground_grey: float = Light.ground_grey
    background_grey: float = Light.background_grey
    gradient: Pair = [0.0, 0.0]
    vignetting: float = 0.0
    glare: list[GlareModel] = []


class SensorModel(_Model):
    """Blur, gamma, noise and bits, as `dishmap.simulate.scene.Sensor`."""

    psf_sigma_px: float = Sensor.psf_sigma_px
    gamma: float = Sensor.gamma
    noise_grey: float = 1.0
    electrons_per_grey: float | None = None
    bits: int = Sensor.bits


class GapModel(_Model):
    """Missing ink of a line of a grid, as `dishmap.simulate.scene.LineGap`."""

    line: int
    start: float
    stop: float


class PrintModel(_Model):
    """Ink spread, the margin of a pattern without a rim, and where a grid's lines are broken."""

    ink_spread_mm: float = Scene.ink_spread_mm
    margin_mm: float = Scene.margin_mm
    broken_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    gaps: list[GapModel] = []


class RibsModel(_Model):
    """Evenly spaced struts over the rim, as `dishmap.simulate.scene.Ribs`."""

    count: Annotated[int, Field(le=1000)]
    width_mm: float
    inner_radius_mm: float
    outer_radius_mm: float
    grey: float
    first_deg: float = 0.0
    front: bool = Ribs.front


class ShapeModel(_Model):
    """A disc (center_px, radius_px) or a polygon (corners_px) in the image plane."""

    center_px: Pair | None = None
    radius_px: float | None = None
    corners_px: list[Pair] | None = None
    grey: float = 0.0


class ClutterModel(_Model):
    """Random shapes behind the surface: how many of each, least and greatest size and grey."""

    discs: Annotated[int, Field(ge=0, le=10000)] = 0
    rings: Annotated[int, Field(ge=0, le=10000)] = 0
    rectangles: Annotated[int, Field(ge=0, le=10000)] = 0
    size_px: Pair = [5.0, 40.0]
    grey: Pair = [20.0, 200.0]


class ZernikeModel(_Model):
    """A Zernike term by its name (`defocus`, `astigmatism_sin`) or by n and m."""

    term: str | None = None
    n: int | None = None
    m: int | None = None
    size_mm: float


class BumpModel(_Model):
    """A Gaussian bump."""

    center_mm: Pair
    sigma_mm: float
    height_mm: float


class CreaseModel(_Model):
    """A straight ridge."""

    point_mm: Pair
    direction_deg: float
    sigma_mm: float
    height_mm: float


class GoresModel(_Model):
    """Cloth between ribs."""

    count: int
    depth_mm: float


class MotionModel(_Model):
    """A rigid motion of the dish in its own frame."""

    rotation_vector_deg: Triple = [0.0, 0.0, 0.0]
    translation_mm: Triple = [0.0, 0.0, 0.0]


class StateModel(_Model):
    """A photograph to be made: its name, and how the surface differs from the nominal one."""

    name: Annotated[str, Field(pattern=NAME)]
    zernike: list[ZernikeModel] = []
    bumps: list[BumpModel] = []
    creases: list[CreaseModel] = []
    gores: list[GoresModel] = []
    expansion_ppm: float = 0.0
    slide: Literal["least_strain", "normal"] = "least_strain"
    motion: MotionModel = MotionModel()


class ScenarioModel(_Model):
    """The whole file."""

    format: Literal["dishmap-scenario/1"]
    name: str = "scenario"
    seed: Annotated[int, Field(ge=0)] = 0
    pattern: PatternSource
    camera: CameraSource
    pose: PoseModel
    light: LightModel = LightModel()
    sensor: SensorModel = SensorModel()
    print: PrintModel = PrintModel()
    ribs: list[RibsModel] = []
    clutter: ClutterModel = ClutterModel()
    background: list[ShapeModel] = []
    occluders: list[ShapeModel] = []
    states: list[StateModel] = [StateModel(name="ref")]


def read_scenario(path: str | os.PathLike[str]) -> Scenario:
    """Read a scenario file and the files it names. Raises InputError, naming the file and what is wrong in it."""
    text = toml_text(path, "scenario file")
    return parse_scenario(text, Path(path).parent, str(path))


def parse_scenario(text: str, folder: str | os.PathLike[str] = ".", source: str = "the scenario") -> Scenario:
    """Make a Scenario of the text of a scenario file, whose files are found in `folder`. Raises InputError."""
    content = toml_content(text, source)
    if content.get("format") != FORMAT:
        raise InputError(f"{source} is no scenario file: its first line must be format = {FORMAT!r}")
    model = checked(content, ScenarioModel, source)
    try:
        return _scenario(model, Path(folder))
    except InputError as error:
        # what is wrong with a camera or a pattern stays an error of that kind
        raise type(error)(f"{source}: {error}") from error


def _scenario(model: ScenarioModel, folder: Path) -> Scenario:
    camera = _camera(model.camera, folder)
    clutter = model.clutter
    # the seed's own stream, apart from those of the states' noise
    rng = np.random.default_rng(model.seed)
    shapes = random_shapes(rng, camera, clutter.discs, clutter.rings, clutter.rectangles, _pair(clutter.size_px), _pair(clutter.grey))
    pattern = pattern_of(model.pattern, folder)
    scene = Scene(
        pattern=pattern,
        camera=camera,
        camera_from_dish=_pose(model.pose),
        light=_light(model.light),
        sensor=Sensor(**model.sensor.model_dump()),
        ink_spread_mm=model.print.ink_spread_mm,
        margin_mm=model.print.margin_mm,
        line_gaps=_line_gaps(model, pattern),
        ribs=tuple(_ribs(ribs) for ribs in model.ribs),
        background=(*shapes, *(_shape(shape, "background") for shape in model.background)),
        occluders=tuple(_shape(shape, "occluders") for shape in model.occluders),
    )
    return Scenario(model.name, model.seed, tuple(_state(scene, state) for state in model.states))


def _line_gaps(model: ScenarioModel, pattern: Pattern) -> tuple[LineGap, ...]:
    given = tuple(LineGap(gap.line, gap.start, gap.stop) for gap in model.print.gaps)
    if not model.print.broken_share:
        return given
    # a stream of the seed's own, apart from clutter and noise
    return (*given, *random_line_gaps(np.random.default_rng([model.seed, BROKEN_STREAM]), pattern, model.print.broken_share))


def _camera(model: CameraSource, folder: Path) -> Camera:
    if model.file is not None:
        if model.model_fields_set != {"file"}:
            raise InputError("[camera] needs either file or the camera's numbers, not both")
        return read_camera(folder / model.file)
    width, height, focal = model.width_px, model.height_px, model.focal_px
    if width is None or height is None or focal is None:
        raise InputError("[camera] needs either file, or width_px, height_px and focal_px")
    focal_px = np.broadcast_to(np.asarray(focal, dtype=float), 2).copy()
    principal = np.array([(width - 1) / 2, (height - 1) / 2]) if model.principal_px is None else np.asarray(model.principal_px)
    distortion = model.distortion or ([0.0] * 4 if model.model == "fisheye" else [])
    return Camera(width, height, focal_px, principal, np.asarray(distortion), model.model)


def _pose(model: PoseModel) -> Pose:
    full = model.rotation_vector_deg is not None or model.translation_mm is not None
    if full == (model.distance_mm is not None):
        raise InputError("[pose] needs either rotation_vector_deg and translation_mm, or distance_mm (with tilt_deg, tilt_direction_deg)")
    if model.distance_mm is not None:
        return facing_pose(model.distance_mm, np.radians(model.tilt_deg), np.radians(model.tilt_direction_deg))
    if model.rotation_vector_deg is None or model.translation_mm is None or {"tilt_deg", "tilt_direction_deg"} & model.model_fields_set:
        raise InputError("[pose] needs rotation_vector_deg together with translation_mm, and tilts only with distance_mm")
    return Pose.from_rotation_vector(np.radians(model.rotation_vector_deg), model.translation_mm)


def _light(model: LightModel) -> Light:
    glare = tuple(Glare(_pair(spot.center_px), spot.sigma_px, spot.peak_grey) for spot in model.glare)
    return Light(model.ink_grey, model.ground_grey, model.background_grey, _pair(model.gradient), model.vignetting, glare)


def _ribs(model: RibsModel) -> Ribs:
    return Ribs(**model.model_dump(exclude={"first_deg"}), first_rad=float(np.radians(model.first_deg)))


def _shape(model: ShapeModel, where: str) -> Shape:
    if model.corners_px is not None and model.center_px is None and model.radius_px is None:
        return Polygon(tuple(_pair(corner) for corner in model.corners_px), model.grey)
    if model.corners_px is None and model.center_px is not None and model.radius_px is not None:
        return Disc(_pair(model.center_px), model.radius_px, model.grey)
    raise InputError(f"a shape of {where} needs either center_px and radius_px, or corners_px")


def _state(scene: Scene, model: StateModel) -> State:
    try:
        deformation = Deformation(
            zernike=tuple(_zernike(term) for term in model.zernike),
            bumps=tuple(Bump(_pair(b.center_mm), b.sigma_mm, b.height_mm) for b in model.bumps),
            creases=tuple(Crease(_pair(c.point_mm), float(np.radians(c.direction_deg)), c.sigma_mm, c.height_mm) for c in model.creases),
            gores=tuple(Gores(g.count, g.depth_mm) for g in model.gores),
            expansion_ppm=model.expansion_ppm,
            slide=model.slide,
            motion=Pose.from_rotation_vector(np.radians(model.motion.rotation_vector_deg), model.motion.translation_mm),
        )
    except InputError as error:
        raise InputError(f"state {model.name!r}: {error}") from error
    return State(model.name, scene.with_state(deformation))


def _zernike(model: ZernikeModel) -> ZernikeTerm:
    if model.term is not None and model.n is None and model.m is None:
        return ZernikeTerm(*parse_term(model.term), model.size_mm)
    if model.term is None and model.n is not None and model.m is not None:
        return ZernikeTerm(model.n, model.m, model.size_mm)
    raise InputError("a Zernike term needs either term, or n and m")


def _pair(values: list[float]) -> tuple[float, float]:
    return float(values[0]), float(values[1])
