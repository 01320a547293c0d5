"""Imports go one way, and heavy libraries and the disk stay behind walls.

Why: a reader can take the files in the written order and never meet a name that is explained later; a stage that only
turns records into records can be tested, timed and called on arrays; and a command that needs no picture loads no plotting
library. Each rule is a function from (module, its syntax tree) to complaints, and each is shown to catch a breach.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src" / "dishmap"

# A module imports only from modules above it. A new file is added here, at the place where it belongs.
ORDER = [
    # know nothing of cameras or dishes
    *("errors", "quality", "transforms", "robust"),
    # the camera
    *("camera.model", "camera.planar", "camera.undistort", "camera.board", "camera.chessboard", "camera.charuco"),
    *("camera.bundle", "camera.elimination", "camera.adjustment", "camera.problem", "camera.learning"),
    *("camera.screening", "camera.calibrate", "camera.uncertainty", "camera.lens_choice", "camera.compare_cameras"),
    *("camera.resample", "camera.advice"),
    # shapes in which deformations are spoken of
    *("surface.zernike",),
    # what is printed
    *("targets.pattern", "targets.flat", "targets.gridlines", "targets.symmetry", "targets.builders"),
    "targets.grid_builders",
    # how a printed membrane moves
    *("surface.membrane",),
    # finding it
    *("targets.threshold", "targets.ellipses", "targets.detect", "targets.subpixel"),
    *("targets.grid_nodes", "targets.grid_squares", "targets.grid_crossings", "targets.grid_map", "targets.grid_links"),
    *("targets.grid_walk", "targets.grid_refine", "targets.grid_skips", "targets.grid_mistaken", "targets.grid_detect"),
    # naming it
    *("targets.layout", "targets.rigid", "targets.markgrid", "targets.candidates", "targets.growth", "targets.constellations"),
    *("targets.beam", "targets.search", "targets.rivals", "targets.identify"),
    *("targets.grid_ways", "targets.grid_search", "targets.grid_identify"),
    # measuring it in the raw pixels
    *("targets.solve", "targets.edges", "targets.light", "targets.pixels", "targets.window", "targets.neighbours"),
    *("targets.adjust", "targets.start", "targets.sensitivity", "targets.scene_noise", "targets.glare", "targets.stages"),
    *("targets.settle", "targets.pose", "targets.track"),
    # and the nodes of grids
    *("targets.lattice_map", "targets.grid_shapes", "targets.grid_pixels", "targets.grid_fit", "targets.grid_arms", "targets.grid_stages"),
    *("targets.grid_outcome", "targets.grid_points"),
    # and the surface through all of them
    *("targets.grid_blocks", "targets.grid_spline", "targets.grid_terms", "targets.grid_system"),
    *("targets.grid_start", "targets.grid_learn", "targets.grid_sheet", "targets.grid_poses"),
    # boards of circles
    *("camera.board_labels", "camera.circle_board"),
    # measuring it as the paper does, and the limit of both
    *("targets.groups", "targets.paper", "targets.plane_pose", "targets.grid_corners", "targets.grid_paper"),
    *("targets.bound", "targets.expected", "targets.grid_bound"),
    # the surface through the points
    *("surface.cloud", "surface.paraboloid", "surface.cylinder", "surface.fit"),
    # the difference between two photographs as the paper has it
    *("difference.registration", "difference.ratio", "difference.levels", "difference.paper"),
    # the rim that two photographs are compared against
    *("difference.outline", "difference.profile", "difference.circle", "difference.rimfit", "difference.rim"),
    # and as we have it: one estimate of everything that may have moved
    *("difference.response", "difference.changes", "difference.priors", "difference.model", "difference.joint"),
    *("difference.estimate", "difference.difference_map", "difference.saved", "difference.bound"),
    # photographs with truth
    *("simulate.deform", "simulate.scene", "simulate.forward", "simulate.truth", "simulate.contour", "simulate.grid_ink"),
    "simulate.render",
    *("simulate.scenario",),
    # all of it in one short function
    *("pipeline", "compare", "figures"),
    # and what it would give, before there is a photograph
    "planning",
    # from surface to signal
    *("rf.antenna", "rf.pattern", "rf.deformation"),
    *("rf.smooth_terms", "rf.smooth_fit", "rf.shape_field", "rf.shape_sources"),
    *("rf.feed", "rf.correction", "rf.subreflector", "rf.aperture", "rf.rays", "rf.sources", "rf.farfield"),
    *("rf.beam", "rf.gain", "rf.best_fit", "rf.spread", "rf.state"),
    # and how the subreflector wins gain back
    *("rf.surrogate", "rf.limits", "rf.climb", "rf.starts", "rf.summits", "rf.illumination", "rf.bending"),
    *("rf.correct", "rf.modes", "rf.margin"),
    *("rf.goals", "rf.target_beam"),
    "rf.analysis",
    # paper to print
    *("sheet.shapes", "sheet.pdf", "sheet.svg", "sheet.flatten", "sheet.pieces", "sheet.outline", "sheet.ruled"),
    *("sheet.seams", "sheet.gores", "sheet.markers"),
    *("sheet.boards", "sheet.paper", "sheet.tiles", "sheet.layout", "sheet.printed", "sheet.sheets"),
    # files
    *("io.atomic", "io.archive", "io.image_header", "io.images", "io.picture_file", "io.pose_file", "io.camera_formats", "io.camera_file"),
    "io.pattern_file",
    *("io.toml_file", "io.csv_table"),
    *("io.scenario_pattern", "io.scenario_file", "io.truth_file", "io.points_file", "io.measurement_file", "io.results"),
    *("io.difference_file", "io.difference_map_file", "io.difference_results", "io.board_file", "io.sheet_file"),
    *("io.grasp_text", "io.grasp_surface", "io.grasp_pattern", "io.antenna_file", "io.rf_netcdf", "io.cuts_csv"),
    *("io.shape_input", "io.mask_file", "io.rf_surface", "io.rf_correction", "io.rf_results"),
    # people: what a map says in words, in pictures, on a page
    *(
        "verdict",
        "plot.canvas",
        "plot.photograph",
        "plot.maps",
        "plot.grid_outlines",
        "plot.outlines",
        "plot.scene",
        "plot.calibration",
        "page",
        "report",
    ),
    "calibration_report",
    # and what a difference says
    *("difference_verdict", "difference_assumptions", "plot.difference", "plot.difference_photograph", "plot.difference_scene"),
    *("difference_report",),
    # and what a plan says
    *("planning_verdict", "planning_report", "io.plan_file"),
    # and what an antenna's gain says
    *("plot.rf_maps", "plot.rf_pattern", "plot.rf_bars", "plot.rf_antenna"),
    *("rf_verdict", "rf_tables", "rf_assumptions", "rf_report"),
    # the program
    *("cli.terminal", "cli.options", "cli.prior_options", "cli.outcome", "cli.difference_outcome"),
    *("cli.board_options", "cli.calibrate", "cli.pattern", "cli.sheet", "cli.plan", "cli.simulate", "cli.undistort"),
    *("cli.map", "cli.diff", "cli.rf", "cli.demo_gain", "cli.demo", "cli.app", "__main__"),
]

# library -> modules (or packages) that may import it, and why only they
WALLS = {
    # pictures are made in one place, so that nothing else waits for a plotting library to load
    "matplotlib": ["plot"],
    "plotly": ["report", "difference_report"],
    # parsing, printing and exits belong to the program, not to the functions that others call
    "click": ["cli"],
    "rich": ["cli"],
    # OpenCV stays where pixels are; geometry is ours, with Jacobians
    "cv2": [
        "camera.undistort",
        "camera.chessboard",
        "camera.charuco",
        "targets.threshold",
        "targets.detect",
        "targets.grid_crossings",
        "targets.plane_pose",
        "targets.grid_corners",
        "io.images",
        "io.camera_file",
        "io.picture_file",
        "plot",
        "difference.outline",
        "sheet.markers",
    ],
    # files that people write are checked where they are read
    "pydantic": ["io", "cli"],
    "pydantic_core": ["io"],
    "xarray": ["io"],
    # Fourier sums over scattered points
    "finufft": ["rf.farfield"],
}
# numpy and scipy may stand anywhere; a library in neither list is not a dependency of this project
FREE = ["numpy", "scipy", "threadpoolctl"]

# Only these touch the disk.
DISK = ["io", "cli"]
DISK_CALLS = {
    *("open", "read_text", "read_bytes", "write_text", "write_bytes", "mkdir", "makedirs", "unlink", "rmdir", "touch", "rename"),
    *("imread", "imwrite", "FileStorage", "savetxt", "loadtxt", "genfromtxt", "savez", "savez_compressed", "tofile", "fromfile", "memmap"),
    *("write_html", "write_image"),
}
DISK_MODULES = ["shutil", "tempfile", "glob"]
# Only the program prints and exits.
PROGRAM = ["cli", "__main__"]
PROGRAM_CALLS = {"print", "input", "exit", "quit", "_exit"}

# Loaded by a plain `import dishmap`, each of these costs a user more than all of dishmap.
HEAVY = ["cv2", "finufft", "scipy", "pydantic", "matplotlib", "plotly", "click", "rich", "xarray", "numpy"]
# The ground floor: people who only read a pattern or project points wait for numpy alone.
LIGHT = ["errors", "quality", "transforms", "camera.model", "targets.pattern"]

Rule = Callable[[str, ast.Module], Iterator[str]]


def modules() -> dict[str, ast.Module]:
    """Every module of the package by its dotted name below `dishmap` (a package's __init__ by the package's name)."""
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text(encoding="utf-8"))
    return found


MODULES = modules()
PACKAGES = {".".join(path.relative_to(SOURCE).parent.parts) for path in SOURCE.rglob("*.py")}


def imported(tree: ast.Module) -> Iterator[str]:
    """Dotted names that a module imports anywhere in it: in functions and under TYPE_CHECKING too.

    `from a import b` gives `a.b`; whether b is a module or a name in one is for the caller to see. A relative import gives
    its dots first.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and called(node) in ("import_module", "__import__"):
            argument = node.args[0] if node.args else None
            yield str(argument.value) if isinstance(argument, ast.Constant) else "?"


def called(node: ast.Call) -> str:
    return node.func.id if isinstance(node.func, ast.Name) else node.func.attr if isinstance(node.func, ast.Attribute) else ""


def within(module: str, places: list[str]) -> bool:
    return any(module == place or module.startswith(f"{place}.") for place in places)


def own(name: str) -> str | None:
    """The module of this package, without `dishmap.`, that an imported dotted name means; None for other libraries."""
    top, _, rest = name.partition(".")
    if top != "dishmap":
        return None
    # the longest part that is a module: the rest are names in it
    while rest and rest not in ORDER and rest not in MODULES:
        rest = rest.rpartition(".")[0]
    return rest


def one_way(module: str, tree: ast.Module) -> Iterator[str]:
    """Imports from earlier modules only."""
    for name in imported(tree):
        target = own(name)
        if name.startswith("."):
            yield f"{module} imports {name}: write the whole name, dishmap.…"
        elif name == "dishmap.__version__" or target is None:
            continue
        elif target in PACKAGES:
            yield f"{module} imports {name}: import from the module that defines it, not from a package"
        elif module in ORDER and target in ORDER and ORDER.index(target) >= ORDER.index(module):
            yield f"{module} imports {target}, which stands at or below it in ORDER"


def walls(module: str, tree: ast.Module) -> Iterator[str]:
    """Libraries only where they are let in."""
    for name in imported(tree):
        library = name.partition(".")[0]
        if library in ("", "dishmap", "__future__", *FREE) or library in sys.stdlib_module_names:
            continue
        if library not in WALLS:
            yield f"{module} imports {library}, which is not a dependency of this project"
        elif not within(module, WALLS[library]):
            yield f"{module} imports {library}; only {', '.join(WALLS[library])} may"


def disk(module: str, tree: ast.Module) -> Iterator[str]:
    """Files are read and written in io and cli only."""
    if within(module, DISK):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and called(node) in DISK_CALLS:
            yield f"{module}, line {node.lineno}, calls {called(node)}: only {', '.join(DISK)} touch the disk"
    for name in imported(tree):
        if name.partition(".")[0] in DISK_MODULES:
            yield f"{module} imports {name}: only {', '.join(DISK)} touch the disk"


def program(module: str, tree: ast.Module) -> Iterator[str]:
    """Printing, asking and exits are the program's."""
    if within(module, PROGRAM):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and called(node) in PROGRAM_CALLS:
            yield f"{module}, line {node.lineno}, calls {called(node)}: only {', '.join(PROGRAM)} may"


def randomness(module: str, tree: ast.Module) -> Iterator[str]:
    """Random numbers come from a Generator that the caller passes; nothing has hidden random state."""
    for name in imported(tree):
        if name.partition(".")[0] in ("random", "secrets"):
            yield f"{module} imports {name}: take a numpy Generator as an argument"


def empty_package(module: str, tree: ast.Module) -> Iterator[str]:
    """A package's __init__ holds its docstring only, so that importing one module loads no other.

    The program is the exception: the installed command and `python -m` name its package.
    """
    if module in PACKAGES and module not in PROGRAM and len(tree.body) != 1:
        yield f"{module}/__init__.py holds more than a docstring"


RULES: list[Rule] = [one_way, walls, disk, program, randomness, empty_package]


def test_every_module_has_a_place_in_the_order() -> None:
    unknown = sorted(set(MODULES) - set(ORDER) - PACKAGES)
    assert not unknown, f"add {', '.join(unknown)} to ORDER in {Path(__file__).name}, after everything it imports"


def test_every_folder_is_a_package() -> None:
    # without __init__.py a folder still imports, but docs and type checks pass it by
    assert set(MODULES) >= PACKAGES, f"add __init__.py to {', '.join(sorted(PACKAGES - set(MODULES)))}"


def test_the_order_names_only_what_exists() -> None:
    assert len(ORDER) == len(set(ORDER))
    missing = [name for name in ORDER if name not in MODULES]
    assert not missing, f"take {', '.join(missing)} out of ORDER in {Path(__file__).name}: there is no such module"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_rule_holds(rule: Rule) -> None:
    complaints = [complaint for name, tree in MODULES.items() if name for complaint in rule(name, tree)]
    assert not complaints, "\n".join(complaints)


@pytest.mark.parametrize(
    ("rule", "module", "code", "complaint"),
    [
        (one_way, "errors", "import dishmap.transforms", "errors imports transforms"),
        (one_way, "errors", "from dishmap import transforms", "errors imports transforms"),
        (one_way, "errors", "def f():\n    from dishmap.camera.model import Camera", "errors imports camera.model"),
        (one_way, "errors", "if TYPE_CHECKING:\n    from dishmap.transforms import Pose", "errors imports transforms"),
        (one_way, "errors", "import_module('dishmap.transforms')", "errors imports transforms"),
        (one_way, "errors", "from dishmap.errors import InputError", "at or below"),
        (one_way, "cli", "from . import errors", "write the whole name"),
        (one_way, "camera.model", "from .model import Camera", "write the whole name"),
        (one_way, "cli", "from dishmap import Camera", "from the module that defines it"),
        (one_way, "cli", "from dishmap.camera import Camera", "from the module that defines it"),
        (walls, "targets.pose", "import cv2", "targets.pose imports cv2; only"),
        (walls, "pipeline", "def f():\n    from matplotlib import pyplot", "pipeline imports matplotlib; only plot may"),
        (walls, "plot", "import plotly.graph_objects", "plot imports plotly; only report, difference_report may"),
        (walls, "pipeline", "from rich.progress import track", "only cli may"),
        (walls, "pipeline", "import torch", "not a dependency"),
        (disk, "pipeline", "open('a')", "calls open"),
        (disk, "pipeline", "path.write_text('a')", "calls write_text"),
        (disk, "targets.detect", "cv2.imread('a')", "calls imread"),
        (disk, "pipeline", "import tempfile", "imports tempfile"),
        (program, "io.images", "print('a')", "calls print"),
        (program, "pipeline", "sys.exit(2)", "calls exit"),
        (randomness, "robust", "import random", "imports random"),
        (empty_package, "camera", "'Cameras.'\nfrom dishmap.camera.model import Camera", "more than a docstring"),
    ],
)
def test_rule_catches_a_breach(rule: Rule, module: str, code: str, complaint: str) -> None:
    assert any(complaint in found for found in rule(module, ast.parse(code)))


@pytest.mark.parametrize(
    ("rule", "module", "code"),
    [
        (one_way, "transforms", "from dishmap.errors import InputError"),
        (one_way, "cli", "from dishmap import __version__"),
        (one_way, "cli", "from dishmap.camera import model"),
        (walls, "plot", "import matplotlib.pyplot as plt"),
        (walls, "robust", "import numpy, scipy.linalg, math"),
        (disk, "io.images", "open('a')"),
        (program, "cli", "print('a')"),
        (empty_package, "camera", "'Cameras.'"),
    ],
)
def test_rule_lets_good_code_through(rule: Rule, module: str, code: str) -> None:
    assert list(rule(module, ast.parse(code))) == []


def loaded_after(statement: str) -> set[str]:
    """Top-level names of what a fresh interpreter has loaded after a statement."""
    code = f"{statement}\nimport json, sys\nprint(json.dumps(sorted({{name.partition('.')[0] for name in sys.modules}})))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(run.stdout))


def test_importing_dishmap_loads_nothing_heavy() -> None:
    assert loaded_after("import dishmap; dir(dishmap); dishmap.__version__").isdisjoint(HEAVY)


@pytest.mark.parametrize("module", LIGHT)
def test_the_ground_floor_loads_only_numpy(module: str) -> None:
    assert loaded_after(f"import dishmap.{module}") & set(HEAVY) <= {"numpy"}


def test_the_check_of_loaded_modules_sees_one() -> None:
    assert "scipy" in loaded_after("import scipy")
