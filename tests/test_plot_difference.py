"""Charts of a difference: colours that do not blow up noise, arrows of the right length, and nothing that breaks on little data."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import matplotlib
import numpy as np
import pytest
from differences import PLATE, joint_of

from dishmap.compare import joint_table
from dishmap.plot.difference import change_map, misfit_histogram, misfit_map, ratio_map_chart, zernike_bars
from dishmap.plot.difference_photograph import arrows_of, arrows_svg
from dishmap.plot.difference_scene import difference_scene, exaggeration
from dishmap.plot.maps import marks

SVG = "{http://www.w3.org/2000/svg}"
XY = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 80.0], [100.0, 80.0], [40.0, 30.0]])
IDS = np.arange(5) + 10
NONE, ALL = np.zeros(5, dtype=bool), np.ones(5, dtype=bool)
# A place in the SVG is written to a tenth of a unit.
UNIT_ROUNDING = 0.051
MOVES = np.array([[0.5, 0.0], [0.0, 0.5], [-0.3, 0.4], [0.0, 0.0], [0.2, 0.1]])


def end_color(end: float) -> str:
    return str(matplotlib.colors.to_hex(matplotlib.colormaps["RdBu_r"](end)))


def is_svg(text: str) -> bool:
    return ET.fromstring(text).tag == f"{SVG}svg" and not re.search(r"\bnan\b", re.sub(r'base64,[^"]*', "", text))


def dots_of(svg: str) -> str:
    """The part of a map before its scale of colours."""
    return svg.split('id="axes_2"', maxsplit=1)[0]


def test_noise_is_pale_and_a_change_is_not() -> None:
    change = np.array([1.0, -1.0, 0.5, 0.2, -0.1])
    strong = change_map(XY, 0.1 * change, np.full(5, 0.004), NONE, IDS, "mm")
    assert end_color(1.0) in dots_of(strong)
    assert end_color(0.0) in dots_of(strong)
    # the same pattern within a sigma stays away from the ends of the scale
    weak = change_map(XY, 0.004 * change, np.full(5, 0.004), NONE, IDS, "mm")
    assert end_color(1.0) not in dots_of(weak)
    assert end_color(0.0) not in dots_of(weak)


@pytest.mark.parametrize(
    ("count", "sigma", "size"), [(1, 0.0, 0.0), (1, 0.01, 0.05), (2, np.nan, 0.05), (3, 0.01, 0.05), (5, 0.0, 0.0), (5, np.nan, 0.05)]
)
def test_maps_of_few_or_equal_points(count: int, sigma: float, size: float) -> None:
    some = size * np.arange(5.0)[:count]
    for aside in (ALL[:count], np.arange(count) == 0):
        assert is_svg(change_map(XY[:count], some, np.full(count, sigma), aside, IDS[:count], "mm"))
        assert is_svg(misfit_map(XY[:count], np.abs(some), aside, IDS[:count]))
        assert is_svg(misfit_histogram(np.abs(some), aside))


def test_an_outlier_does_not_set_the_scale() -> None:
    aside = np.arange(5) == 2
    svg = change_map(XY, np.array([0.1, -0.1, 50.0, 0.0, 0.05]), np.full(5, 0.01), aside, IDS, "mm")
    assert end_color(1.0) in dots_of(svg)


@pytest.mark.parametrize("used", [NONE, ALL])
def test_ratio_maps(used: np.ndarray) -> None:
    pair = np.array([[0, 1], [0, 2], [1, 3], [2, 3], [0, 4]])
    assert is_svg(ratio_map_chart(XY, pair, 1 + 1e-4 * np.arange(-2, 3), used))
    many = np.tile(pair, (200, 1))
    assert is_svg(ratio_map_chart(XY, many, np.ones(1000), np.tile(used, 200)))


def test_bars_of_terms_told_from_zero_have_their_color() -> None:
    told, untold = (zernike_bars(["defocus (2, 0)"], np.array([0.1]), np.array([s])) for s in (0.01, 0.2))
    assert "#0072b2" in told
    assert "#0072b2" not in untold
    assert is_svg(zernike_bars(["a", "b"], np.zeros(2), np.zeros(2)))


def arrow_lengths(svg: str) -> list[float]:
    """Distance from dot to tip of each arrow, in units; 0 for a dot alone. The last is that of the legend."""
    lengths = []
    for group in ET.fromstring(svg).iter(f"{SVG}g"):
        dot = next(group.iter(f"{SVG}circle"))
        tips = [path.get("d") for path in group.iter(f"{SVG}path") if path.get("d").endswith("z")]
        if not tips:
            lengths.append(0.0)
            continue
        x, y = map(float, re.match(r"M([-\d.]+) ([-\d.]+)L", tips[0]).groups())
        lengths.append(float(np.hypot(x - float(dot.get("cx")), y - float(dot.get("cy")))))
    return lengths


def test_arrows_are_as_long_as_is_said() -> None:
    arrows = arrows_of((640, 480), 4 * XY + 60, MOVES, ("t",) * 5)
    assert arrows.factor > 1
    assert not arrows.cut.any()
    *drawn, key = arrow_lengths(arrows_svg(None, arrows, "arrows"))
    per_px = arrows.factor * arrows.frame.scale
    np.testing.assert_allclose(drawn, per_px * np.hypot(*MOVES.T), atol=2 * UNIT_ROUNDING)
    words = "".join(ET.fromstring(arrows_svg(None, arrows, "arrows")).itertext())
    said, factor = re.search(r"([\d.]+) px in the picture, drawn (\d+) times enlarged", words).groups()
    assert float(factor) == arrows.factor
    assert key == pytest.approx(float(said) * per_px, abs=2 * UNIT_ROUNDING)


def test_a_stray_arrow_is_cut_and_said_to_be() -> None:
    many = np.column_stack([np.tile(np.arange(10), 4), np.repeat(np.arange(4), 10)]) * 50.0 + 80
    moves = np.full((40, 2), 0.1)
    moves[7] = [0.0, 40.0]
    arrows = arrows_of((640, 480), many, moves, ("t",) * 40)
    assert np.flatnonzero(arrows.cut).tolist() == [7]
    svg = arrows_svg(None, arrows, "arrows")
    assert max(arrow_lengths(svg)) == pytest.approx(1.6 * arrows.usual, abs=2 * UNIT_ROUNDING)
    assert "orange: cut" in svg


def test_arrows_of_one_target_and_of_none_that_moved() -> None:
    assert is_svg(arrows_svg(np.full((480, 640), 90, np.uint8), arrows_of((640, 480), XY[:1] + 200, MOVES[:1], ("t",)), "one"))
    still = arrows_of((640, 480), XY + 200, np.zeros((5, 2)), ("t",) * 5)
    assert still.factor == 1
    assert "no target moved" in arrows_svg(None, still, "none")


def test_large_moves_are_drawn_at_true_scale() -> None:
    arrows = arrows_of((640, 480), 4 * XY + 60, 200 * MOVES, ("t",) * 5)
    assert arrows.factor == 1
    assert "times enlarged" not in arrows_svg(None, arrows, "arrows")


def test_noise_is_not_exaggerated_to_hills() -> None:
    rows = joint_table(joint_of(PLATE, shape_mm=np.full(len(PLATE), 1e-6)))
    span = float(np.ptp(PLATE.center_mm[:, 0]))
    # three sigmas may fill the part of the picture that changes get
    assert exaggeration(rows) * 3 * float(np.median(rows.sigma_shape_mm)) <= 0.12 * span
    traces, layout = difference_scene(rows, PLATE.normal)
    assert layout["scene"]["zaxis"]["range"][0] < 0 < layout["scene"]["zaxis"]["range"][1]
    assert {trace["type"] for trace in traces} == {"mesh3d", "scatter3d"}


def test_of_many_targets_some_arrows_are_drawn_the_longest_among_them() -> None:
    columns, rows = np.meshgrid(np.arange(50.0), np.arange(40.0))
    at = 100 + 20 * np.column_stack([columns.ravel(), rows.ravel()])
    move = np.full((2000, 2), 0.1)
    move[777] = [0.9, 0.0]
    arrows = arrows_of((1200, 1000), at, move, tuple(str(i) for i in range(2000)))
    assert arrows.of == 2000
    assert 200 < len(arrows.titles) < 1000
    assert "777" in arrows.titles
    # each stays with its own title
    assert all((arrows.from_px[k] == at[int(title)]).all() for k, title in enumerate(arrows.titles))
    assert is_svg(arrows_svg(None, arrows, "many"))
    few = arrows_of((1200, 1000), at[::97], move[::97], tuple(str(i) for i in range(21)))
    assert len(few.titles) == few.of == 21


def test_marks_shrink_where_points_are_many() -> None:
    columns, rows = np.meshgrid(np.arange(45.0), np.arange(45.0))
    many = np.column_stack([columns.ravel(), rows.ravel()])
    # marks of the usual size would hide each other: as wide as the way to the next, in a map of some 330 points
    assert marks(many, 26)["s"] < (330 / 45) ** 2 / 2
    assert marks(XY, 26)["s"] == pytest.approx(26)
