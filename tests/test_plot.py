"""Charts and the marked photograph: right places and colours, nothing that breaks on little data, the same bytes each time."""

from __future__ import annotations

import base64
import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.colors import LogNorm, Normalize

from dishmap.camera.model import Camera
from dishmap.camera.uncertainty import projection_error
from dishmap.plot.calibration import coverage_map, view_bars
from dishmap.plot.canvas import color_norm, hex_colors, round_length
from dishmap.plot.maps import normals_map, ratio_histogram, residual_map, sigma_map
from dishmap.plot.photograph import Outline, error_svg, frame_of, photograph_frame, photograph_svg

SVG = "{http://www.w3.org/2000/svg}"
# A place in the SVG is written to a tenth of a unit.
UNIT_ROUNDING = 0.051
# JPEG at the quality used keeps a smooth picture to a few grey levels.
JPEG_GREY = 3.0
XY = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 80.0], [100.0, 80.0], [40.0, 30.0]])
IDS = np.arange(5) + 10
NONE_OFF = np.zeros(5, dtype=bool)


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in ET.fromstring(svg).iter(f"{SVG}text")]


def square_outline(at_px: tuple[float, float], **change: object) -> Outline:
    center = np.array(at_px)
    ellipse = np.array([[[0.0, 0.0], [6.0, 0.0], [0.0, 3.0]]]) + center
    return replace(Outline(ellipse, center, "7", "target 7", 0.1, "good"), **change)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "values"), [(1, np.zeros(5)), (2, np.full(5, 0.2)), (4, np.zeros(5)), (4, np.array([-1, 2, 0.5, 0.1, 3]))]
)
def test_maps_of_few_or_equal_points(count: int, values: np.ndarray) -> None:
    xy, some, off = XY[:count], values[:count], NONE_OFF[:count]
    for svg in (residual_map(xy, some, off, IDS[:count], "mm"), sigma_map(xy, np.abs(some) + 0.01, "mm"), normals_map(xy, 0.01 * xy, "a")):
        assert ET.fromstring(svg).tag == f"{SVG}svg"


def test_maps_of_points_on_one_line_and_in_one_place() -> None:
    for xy in (np.column_stack([np.arange(5.0), 2 * np.arange(5.0)]), np.zeros((5, 2))):
        assert residual_map(xy, np.arange(5.0) - 2, NONE_OFF, IDS, "mm").startswith("<svg")
        assert normals_map(xy, np.zeros((5, 2)), "a").startswith("<svg")


def test_all_points_off_the_surface() -> None:
    assert residual_map(XY, np.arange(5.0), ~NONE_OFF, IDS, "mm").startswith("<svg")


def test_residuals_of_opposite_sign_get_opposite_colors() -> None:
    points = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    # the dots are filled paths: with one sign only, no dot is of the other end's colour
    red, blue = (hex_of_end(end) for end in (1.0, 0.0))
    positive = residual_map(points, np.array([1.0, 1.0, 1.0]), np.zeros(3, dtype=bool), np.arange(3), "mm").split('id="axes_2"')[0]
    assert red in positive
    assert blue not in positive
    negative = residual_map(points, np.array([-1.0, -1.0, -1.0]), np.zeros(3, dtype=bool), np.arange(3), "mm").split('id="axes_2"')[0]
    assert blue in negative
    assert red not in negative


def hex_of_end(end: float) -> str:
    return str(matplotlib.colors.to_hex(matplotlib.colormaps["RdBu_r"](end)))


@pytest.mark.parametrize(("count", "spread"), [(1, 0.0), (4, 1.0), (130, 0.3), (130, 40.0)])
def test_histograms_of_any_spread(count: int, spread: float) -> None:
    ratio = np.random.default_rng(1).normal(size=count) * spread
    assert ratio_histogram(ratio, spread).startswith("<svg")


def test_charts_are_the_same_each_time_and_leave_no_trace() -> None:
    with matplotlib.rc_context({"font.size": 30.0, "axes.facecolor": "red"}):
        before = dict(matplotlib.rcParams)
        first = sigma_map(XY, np.arange(5.0) + 1, "mm")
        assert dict(matplotlib.rcParams) == before
    assert first == sigma_map(XY, np.arange(5.0) + 1, "mm")
    assert "http" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", re.sub(r"<metadata>.*?</metadata>", "", first, flags=re.DOTALL))


def test_the_scale_of_colors() -> None:
    assert isinstance(color_norm([1.0, 100.0]), LogNorm)
    assert type(color_norm([1.0, 1.1])) is Normalize
    assert type(color_norm([0.0, 1.1])) is Normalize
    for values in ([], [0.2], [0.0, 0.0], [np.nan]):
        norm = color_norm(values)
        assert norm.vmin is not None
        assert norm.vmax is not None
        assert norm.vmin < norm.vmax
    colors = hex_colors([0.0, 1.0], Normalize(0, 1))
    # the ends of viridis (van der Walt and Smith, 2015)
    assert colors == ["#440154", "#fde724"] or colors == ["#440154", "#fde725"]


@pytest.mark.parametrize(("length", "expected"), [(0.37, 0.2), (0.5, 0.5), (1.0, 1.0), (9.9, 5.0), (2.1e-5, 2e-5), (300.0, 200.0)])
def test_round_lengths(length: float, expected: float) -> None:
    assert round_length(length) == pytest.approx(expected)


def test_an_outline_lies_where_the_pixel_is() -> None:
    image = np.full((300, 400), 120, np.uint8)
    outlines = [square_outline((50.0, 60.0)), square_outline((350.0, 240.0), sigma=0.3)]
    frame = photograph_frame(image, outlines)
    root = ET.fromstring(photograph_svg(image, frame, outlines, "sigma", "alt"))
    matrices = [c.get("transform", "") for c in root.iter(f"{SVG}circle")]
    ax, ay, bx, by, x, y = map(float, re.findall(r"-?[\d.]+", matrices[0]))
    # a pixel's middle is half a pixel from its corner
    assert x == pytest.approx((50.5 - frame.columns[0]) * frame.scale, abs=UNIT_ROUNDING)
    assert y == pytest.approx((60.5 - frame.rows[0]) * frame.scale, abs=UNIT_ROUNDING)
    assert (ax, ay, bx, by) == pytest.approx((6 * frame.scale, 0, 0, 3 * frame.scale), abs=UNIT_ROUNDING)


def test_the_picture_shown_is_the_part_of_the_photograph() -> None:
    v, u = np.mgrid[:600, :900]
    image = (40 + 0.1 * u + 0.15 * v).astype(np.uint8)
    outlines = [square_outline((400.0, 300.0)), square_outline((500.0, 380.0))]
    frame = photograph_frame(image, outlines)
    assert 0 < frame.columns[0] < 400
    assert 500 < frame.columns[1] < 900
    svg = photograph_svg(image, frame, outlines, "sigma", "alt")
    found = re.search(r"data:image/jpeg;base64,([^\"]+)", svg)
    assert found is not None
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    expected = image[slice(*frame.rows), slice(*frame.columns)]
    assert shown.shape == expected.shape
    assert np.abs(shown.astype(float) - expected).max() < JPEG_GREY


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_photographs_of_any_depth_become_pictures_of_the_same_greys(dtype: type) -> None:
    image = np.full((2400, 3200), 1000 if dtype != np.uint8 else 100, dtype)
    image[:, :1600] //= 2
    svg = photograph_svg(image, frame_of(3200, 2400), [], "sigma", "alt")
    found = re.search(r"base64,([^\"]+)", svg)
    assert found is not None
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown.shape == (1200, 1600)
    assert shown[600, 400] / shown[600, 1200] == pytest.approx(0.5, abs=0.03)


def test_ids_are_left_out_where_they_would_touch() -> None:
    image = np.zeros((1000, 1000), np.uint8)
    close = [square_outline((100 + 4.0 * i, 500.0 + 300 * (i == 0)), label=str(i)) for i in range(200)]
    far = [square_outline((100 + 80.0 * i, 500.0), label=str(i)) for i in range(10)]
    assert "0" not in texts(photograph_svg(image, frame_of(1000, 1000), close, "sigma", "alt"))
    assert {str(i) for i in range(10)} <= set(texts(photograph_svg(image, frame_of(1000, 1000), far, "sigma", "alt")))


def test_states_differ_by_more_than_color_and_titles_are_escaped() -> None:
    image = np.zeros((100, 100), np.uint8)

    def drawn(state: str) -> str:
        outline = square_outline((50.0, 50.0), state=state, title="<b>&", sigma=0.1 if state == "good" else np.nan)
        return photograph_svg(image, frame_of(100, 100), [outline], "sigma", 'a "b" <c>')

    good, rejected, missing = (drawn(state) for state in ("good", "rejected", "missing"))
    assert "stroke-dasharray" not in good
    assert "stroke-dasharray" in rejected
    assert "<path" in rejected
    assert "stroke-dasharray" in missing
    root = ET.fromstring(good)
    assert root.get("aria-label") == 'a "b" <c>'
    assert next(root.iter(f"{SVG}title")).text == "<b>&"


def test_circles_of_expected_error_grow_with_it() -> None:
    camera = Camera(640, 480, [500.0, 500.0], [319.5, 239.5], covariance=np.diag([1.0, 1.0, 0.0, 0.0]))
    error = projection_error(camera, (3, 5))
    root = ET.fromstring(error_svg(error, 640, 480, "alt"))
    radii = [float(c.get("r", "")) for c in root.iter(f"{SVG}circle")][:15]
    # a wrong focal length moves pixels in proportion to their distance from the middle
    distance = np.hypot(*(error.pixels.reshape(-1, 2) - [319.5, 239.5]).T)
    visible = distance > 1
    assert np.array(radii)[visible] / distance[visible] == pytest.approx(radii[0] / distance[0], rel=0.01)
    assert "base64" not in error_svg(error, 640, 480, "alt")
    assert "base64" in error_svg(error, 640, 480, "alt", np.zeros((480, 640), np.uint8))


def test_a_camera_without_any_error_has_a_picture_too() -> None:
    camera = Camera(64, 48, [50.0, 50.0], [31.5, 23.5], covariance=np.zeros((4, 4)))
    assert error_svg(projection_error(camera, (2, 2)), 64, 48, "alt").startswith("<svg")


@pytest.mark.parametrize("count", [1, 3, 100])
def test_charts_of_a_calibration(count: int) -> None:
    rng = np.random.default_rng(2)
    names = [f"view $_{{{i}}}$ {'long' * 20}" for i in range(count)]
    assert view_bars(names, rng.uniform(0.1, 1, count), 0.5).startswith("<svg")
    used = np.arange(40) > 0
    assert coverage_map(rng.uniform(0, 400, (40, 2)), np.zeros((40, 2)), used, 640, 480).startswith("<svg")
