"""dishmap: the shape of a dish antenna, or of any printed surface, from photographs by one calibrated camera.

The names below are the public ones. Each is loaded when first used, so that `import dishmap` stays quick:

    import dishmap
    camera = dishmap.read_camera("camera.yaml")
    pattern = dishmap.read_pattern("pattern.json")
    result = dishmap.map_photograph(dishmap.read_gray("photo.png"), camera, pattern, dishmap.Upright())

Lengths are in millimetres, image quantities in pixels, angles in radians; pixel (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dishmap.camera.calibrate import calibrate
    from dishmap.camera.chessboard import find_boards
    from dishmap.camera.model import Camera
    from dishmap.camera.undistort import undistort_image, undistort_points
    from dishmap.compare import compare_photographs
    from dishmap.difference.priors import Priors
    from dishmap.io.antenna_file import read_antenna
    from dishmap.io.camera_file import read_camera, write_camera
    from dishmap.io.difference_file import read_difference
    from dishmap.io.difference_map_file import read_difference_map
    from dishmap.io.images import read_gray, read_turn_deg
    from dishmap.io.measurement_file import read_measurement, write_measurement
    from dishmap.io.pattern_file import read_pattern, write_pattern
    from dishmap.io.shape_input import read_shape_field
    from dishmap.io.sheet_file import write_sheets
    from dishmap.pipeline import map_photograph
    from dishmap.planning import Conditions, camera_of_lens, plan
    from dishmap.rf.analysis import RfAnalysis, RfOptions, analyse
    from dishmap.rf.antenna import Antenna
    from dishmap.rf.correct import best_correction
    from dishmap.sheet.boards import charuco, chessboard
    from dishmap.sheet.paper import paper_of
    from dishmap.sheet.sheets import as_printed, board_sheets, pattern_sheets
    from dishmap.simulate.deform import Deformation
    from dishmap.simulate.render import simulate as simulate_photograph
    from dishmap.simulate.scene import Light, Scene, Sensor, facing_pose
    from dishmap.surface.cloud import PointCloud
    from dishmap.surface.fit import Basis, fit_surface
    from dishmap.targets.builders import dish, plate
    from dishmap.targets.detect import find_ellipses
    from dishmap.targets.grid_builders import grid
    from dishmap.targets.grid_detect import find_grid
    from dishmap.targets.grid_identify import identify_grid
    from dishmap.targets.identify import Anchors, PoseGuess, Upright, identify
    from dishmap.targets.pattern import Pattern, Surface, TargetKind
    from dishmap.targets.pose import measure_targets
    from dishmap.targets.stages import Assumptions
    from dishmap.targets.track import track_targets
    from dishmap.transforms import Pose

    __version__: str

# Where each public name lives; the imports above say the same to type checkers, and a test holds the two together.
_HOME = {
    "Anchors": "dishmap.targets.identify",
    "Antenna": "dishmap.rf.antenna",
    "Assumptions": "dishmap.targets.stages",
    "Basis": "dishmap.surface.fit",
    "Camera": "dishmap.camera.model",
    "Conditions": "dishmap.planning",
    "Deformation": "dishmap.simulate.deform",
    "Light": "dishmap.simulate.scene",
    "Pattern": "dishmap.targets.pattern",
    "PointCloud": "dishmap.surface.cloud",
    "Pose": "dishmap.transforms",
    "PoseGuess": "dishmap.targets.identify",
    "Priors": "dishmap.difference.priors",
    "RfAnalysis": "dishmap.rf.analysis",
    "RfOptions": "dishmap.rf.analysis",
    "Scene": "dishmap.simulate.scene",
    "Sensor": "dishmap.simulate.scene",
    "Surface": "dishmap.targets.pattern",
    "TargetKind": "dishmap.targets.pattern",
    "Upright": "dishmap.targets.identify",
    "analyse": "dishmap.rf.analysis",
    "as_printed": "dishmap.sheet.sheets",
    "best_correction": "dishmap.rf.correct",
    "board_sheets": "dishmap.sheet.sheets",
    "calibrate": "dishmap.camera.calibrate",
    "camera_of_lens": "dishmap.planning",
    "charuco": "dishmap.sheet.boards",
    "chessboard": "dishmap.sheet.boards",
    "compare_photographs": "dishmap.compare",
    "dish": "dishmap.targets.builders",
    "facing_pose": "dishmap.simulate.scene",
    "find_boards": "dishmap.camera.chessboard",
    "find_ellipses": "dishmap.targets.detect",
    "find_grid": "dishmap.targets.grid_detect",
    "fit_surface": "dishmap.surface.fit",
    "grid": "dishmap.targets.grid_builders",
    "identify": "dishmap.targets.identify",
    "identify_grid": "dishmap.targets.grid_identify",
    "map_photograph": "dishmap.pipeline",
    "measure_targets": "dishmap.targets.pose",
    "track_targets": "dishmap.targets.track",
    "paper_of": "dishmap.sheet.paper",
    "pattern_sheets": "dishmap.sheet.sheets",
    "plan": "dishmap.planning",
    "plate": "dishmap.targets.builders",
    "read_antenna": "dishmap.io.antenna_file",
    "read_camera": "dishmap.io.camera_file",
    "read_difference": "dishmap.io.difference_file",
    "read_difference_map": "dishmap.io.difference_map_file",
    "read_gray": "dishmap.io.images",
    "read_measurement": "dishmap.io.measurement_file",
    "read_pattern": "dishmap.io.pattern_file",
    "read_shape_field": "dishmap.io.shape_input",
    "read_turn_deg": "dishmap.io.images",
    "simulate_photograph": "dishmap.simulate.render",
    "undistort_image": "dishmap.camera.undistort",
    "undistort_points": "dishmap.camera.undistort",
    "write_camera": "dishmap.io.camera_file",
    "write_measurement": "dishmap.io.measurement_file",
    "write_pattern": "dishmap.io.pattern_file",
    "write_sheets": "dishmap.io.sheet_file",
}
# `dishmap.simulate` is the package, so its function of that name goes by another one here.
_OTHER_NAME = {"simulate_photograph": "simulate"}

__all__ = [
    "Anchors",
    "Antenna",
    "Assumptions",
    "Basis",
    "Camera",
    "Conditions",
    "Deformation",
    "Light",
    "Pattern",
    "PointCloud",
    "Pose",
    "PoseGuess",
    "Priors",
    "RfAnalysis",
    "RfOptions",
    "Scene",
    "Sensor",
    "Surface",
    "TargetKind",
    "Upright",
    "__version__",
    "analyse",
    "as_printed",
    "best_correction",
    "board_sheets",
    "calibrate",
    "camera_of_lens",
    "charuco",
    "chessboard",
    "compare_photographs",
    "dish",
    "facing_pose",
    "find_boards",
    "find_ellipses",
    "find_grid",
    "fit_surface",
    "grid",
    "identify",
    "identify_grid",
    "map_photograph",
    "measure_targets",
    "paper_of",
    "pattern_sheets",
    "plan",
    "plate",
    "read_antenna",
    "read_camera",
    "read_difference",
    "read_difference_map",
    "read_gray",
    "read_measurement",
    "read_pattern",
    "read_shape_field",
    "read_turn_deg",
    "simulate_photograph",
    "track_targets",
    "undistort_image",
    "undistort_points",
    "write_camera",
    "write_measurement",
    "write_pattern",
    "write_sheets",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    value: Any
    if name == "__version__":
        value = _version()
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), _OTHER_NAME.get(name, name))
    else:
        raise AttributeError(f"module 'dishmap' has no attribute {name!r}; the public names are {', '.join(sorted(_HOME))}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("dishmap")
    except PackageNotFoundError:
        # run from a source folder that was never installed
        return "unknown"
