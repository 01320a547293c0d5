"""The report of a difference: its numbers are those of the record, it needs nothing but itself, and it holds on little or strange data."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from differences import CAMERA, DISH, PLATE, TERMS, difference_of, joint_of, with_outliers
from test_report import HOSTILE, parsed, words

from dishmap.camera.model import Camera
from dishmap.compare import Difference, compare_photographs
from dishmap.difference.priors import Priors
from dishmap.difference_report import difference_report
from dishmap.difference_verdict import difference_verdict
from dishmap.errors import ImageError
from dishmap.simulate.deform import Bump, Deformation
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Scene, Sensor, facing_pose
from dishmap.surface.zernike import term_name
from dishmap.targets.builders import plate
from dishmap.targets.identify import Upright

# plotly.js itself is 4.8 MB, a photograph and the charts of 130 targets 1.5 MB.
LARGEST_BYTES = 6_500_000
SECTIONS = (
    "What was assumed, and what one camera cannot see",
    "Change of shape",
    "In space",
    "Motion in the picture and displacement",
    "Zernike terms",
    "Robust surface through the change of shape",
    "Residuals",
    "Ways of moving that were weighed",
    "Outliers and flags",
    "All targets",
    "Inputs and versions",
)
IMAGE = np.full((CAMERA.height_px, CAMERA.width_px), 150, dtype=np.uint8)
# A row of the table of targets: id, place, three values with sigma, motion in the picture, misfit, flags.
COLUMNS = 14


@pytest.fixture(scope="module")
def bent_html() -> str:
    return difference_report(difference_of(DISH), IMAGE, HOSTILE, {"reference": HOSTILE, HOSTILE: "sha256 12ab"})


@pytest.fixture(scope="module")
def measured() -> tuple[Difference, np.ndarray]:
    """Six targets with a bump among them, photographed, measured and compared by both methods."""
    camera = Camera(640, 480, [800.0, 800.0], [319.5, 239.5])
    scene = Scene(plate(2, 3, 60), camera, facing_pose(420.0, 0.2, 0.4), sensor=Sensor(noise_grey=1.5))
    rng = np.random.default_rng(1)
    first = simulate(scene, rng).image
    second = simulate(scene.with_state(Deformation(bumps=(Bump((0.0, 0.0), 40.0, 0.5),))), rng).image
    return compare_photographs(first, second, camera, scene.pattern, Upright(), method="all"), second


def headings(html: str) -> list[str]:
    return [h.replace("&#x27;", "'") for h in re.findall(r"<h2>(.*?)</h2>", html)]


def scene_data(html: str) -> list[dict]:
    (call,) = [script for script in parsed(html).scripts if script.startswith("Plotly.newPlot")]
    return json.JSONDecoder().raw_decode(call[call.index("[") :])[0]


def check_whole(html: str) -> None:
    """Well-formed, offline, and without a number that is none."""
    page = parsed(html)
    assert len(html.encode()) < LARGEST_BYTES
    for tag, name, value in page.attributes:
        if name in ("src", "href", "xlink:href", "action", "data", "poster", "srcset"):
            assert value.startswith("data:"), f"{tag} refers to {value[:60]}"
        if tag == "img" and name == "alt":
            assert value
        if tag in ("path", "circle", "text", "svg", "rect", "image"):
            assert "nan" not in value.lower()
    shown = words(html)
    assert not re.search(r"(?<![\w.])(nan|inf|None)(?!\w)", shown), "a number that is none"
    assert not re.search(r"(?<!\S)-0(\.0+)?(?![\d.])", shown), "minus zero"
    for script in page.scripts[1:]:
        assert "NaN" not in script
        assert "Infinity" not in script


def test_all_sections_are_there(bent_html: str) -> None:
    assert tuple(headings(bent_html)) == SECTIONS
    check_whole(bent_html)


def test_the_page_says_what_the_verdict_says(bent_html: str) -> None:
    said, verdict = words(bent_html), difference_verdict(difference_of(DISH))
    assert verdict.headline in said
    for fact in verdict.facts:
        assert f"{fact.name} {fact.value} {fact.detail}" in said


def test_the_table_holds_every_target(bent_html: str) -> None:
    rows = {row[0]: row for row in parsed(bent_html).rows if len(row) == COLUMNS}
    joint = joint_of(DISH)
    for n, ident in enumerate(joint.ids):
        row = rows[str(ident)]
        value = [joint.displacement_mm[n], joint.depth_change_mm[n], joint.shape_mm[n]]
        # half of the last digit shown
        assert np.abs(np.array(row[4:10:2], dtype=float) - value).max() <= 0.000051
        sigma = [joint.sigma_displacement_mm[n], joint.sigma_depth_change_mm[n], joint.sigma_shape_mm[n]]
        np.testing.assert_allclose(np.array(row[5:10:2], dtype=float), sigma, rtol=0.005)
        assert np.abs(np.array(row[10:12], dtype=float) - joint.du_dv_px[n]).max() <= 0.00051
        assert abs(float(row[12]) - joint.misfit[n]) <= 0.0051


def test_zernike_terms_with_their_names(bent_html: str) -> None:
    rows = {row[0]: row for row in parsed(bent_html).rows if len(row) == 4}
    joint = joint_of(DISH)
    sigma = np.sqrt(np.diag(joint.zernike_covariance_mm2))
    for (n, m), size, s in zip(TERMS, joint.zernike_mm, sigma, strict=True):
        row = rows[f"{term_name(n, m).replace('_', ' ')} ({n}, {m})"]
        assert float(row[1]) == pytest.approx(size, abs=0.000051)
        assert float(row[2]) == pytest.approx(s, rel=0.005)
        assert float(row[3]) == pytest.approx(size / s, abs=0.051)


def test_ways_of_moving_with_weights_and_sizes(bent_html: str) -> None:
    rows = [row for row in parsed(bent_html).rows if len(row) == 8 and row[2].endswith("%")]
    assert [row[2] for row in rows] == ["75.0%", "25.0%"]
    assert [row[3] for row in rows] == ["0", "1.10"]
    assert [row[4] for row in rows] == ["0.200", "0.300"]
    assert [row[5] for row in rows] == ["2.00", "2.00"]
    assert "membrane" in rows[0][0]
    assert "boresight" in rows[1][0]


def test_the_3d_picture_shows_targets_at_both_scales(bent_html: str) -> None:
    joint = joint_of(DISH)
    dots = [trace for trace in scene_data(bent_html) if trace.get("mode") == "markers"]
    assert [trace["visible"] for trace in dots] == [True, False]
    factor = float(re.search(r"drawn (\d+) times enlarged or at true scale", words(bent_html))[1])
    for trace, times in zip(dots, (factor, 1.0), strict=True):
        shown = np.array([trace[axis] for axis in "xyz"]).T
        # coordinates are rounded to a tenth of a micrometre
        np.testing.assert_allclose(shown, DISH.center_mm + times * joint.shape_mm[:, None] * DISH.normal, atol=6e-5)
        np.testing.assert_allclose(trace["marker"]["color"], joint.shape_mm, atol=6e-7)


def test_text_of_the_user_stays_text(bent_html: str) -> None:
    assert HOSTILE not in bent_html
    assert len(parsed(bent_html).scripts) == 2
    assert words(bent_html).count(" ".join(HOSTILE.split())) >= 3


def test_the_same_difference_gives_the_same_page(bent_html: str) -> None:
    again = difference_report(difference_of(DISH), IMAGE, HOSTILE, {"reference": HOSTILE, HOSTILE: "sha256 12ab"})
    assert again == bent_html


def test_a_measured_difference_by_both_methods(measured: tuple[Difference, np.ndarray]) -> None:
    result, image = measured
    html = difference_report(result, image, "six targets", {})
    check_whole(html)
    assert "By the paper's method" in headings(html)
    # six targets are too few for Zernike terms
    assert "Zernike terms" not in headings(html)
    assert result.paper is not None
    used = int((result.paper.confidence > 0).sum())
    assert f"Pairs used {used} of {len(result.paper.ratios)}" in words(html)


def test_the_paper_alone(measured: tuple[Difference, np.ndarray]) -> None:
    result, image = measured
    alone = replace(result, method="paper", joint=None, tables={"paper": result.tables["paper"]})
    html = difference_report(alone, image, "six targets", {})
    check_whole(html)
    assert "whether that is significant the method does not say" in words(html).lower()
    assert "Ways of moving that were weighed" not in headings(html)


@pytest.mark.parametrize("rows", [[4], list(range(12))], ids=["one", "all"])
def test_targets_put_aside(rows: list[int]) -> None:
    html = difference_report(difference_of(PLATE, with_outliers(joint_of(PLATE), rows)), IMAGE, "outliers", {})
    check_whole(html)
    listed = [row for row in parsed(html).rows if len(row) == 2 and row[1].startswith("its change fits no smooth motion")]
    assert [row[0] for row in listed] == [str(PLATE.ids[row]) for row in rows]
    flagged = [row for row in parsed(html).rows if len(row) == COLUMNS and row[-1] == "outlier"]
    assert [row[0] for row in flagged] == [row[0] for row in listed]


def test_nothing_moved_at_all() -> None:
    n = len(PLATE)
    zero = dict.fromkeys(("displacement_mm", "depth_change_mm", "shape_mm", "misfit", "shape_own_mm2"), np.zeros(n))
    zero |= dict.fromkeys(("sigma_displacement_mm", "sigma_depth_change_mm", "sigma_shape_mm"), np.zeros(n))
    html = difference_report(difference_of(PLATE, joint_of(PLATE, du_dv_px=np.zeros((n, 2)), **zero)), IMAGE, "zero", {})
    check_whole(html)
    assert "no target moved in the picture" in words(html)


def test_without_zernike_terms() -> None:
    none = {"zernike_terms": (), "zernike_mm": np.zeros(0), "zernike_covariance_mm2": np.zeros((0, 0))}
    html = difference_report(difference_of(PLATE, joint_of(PLATE, **none)), IMAGE, "none", {})
    check_whole(html)
    assert "Zernike terms" not in headings(html)


def test_a_rigid_body_has_no_pictures_of_its_shape() -> None:
    n = len(PLATE)
    still = joint_of(PLATE, shape_mm=np.full(n, -1e-17), sigma_shape_mm=np.full(n, 2e-17), priors=Priors(still=True))
    html = difference_report(difference_of(PLATE, still), IMAGE, "still", {})
    check_whole(html)
    assert not {"Change of shape", "In space", "Zernike terms"} & set(headings(html))
    assert not parsed(html).scripts


def test_no_surface_and_no_photograph() -> None:
    result = difference_of(PLATE, surfaces={}, surface_problems={"shape": "too few points."})
    html = difference_report(result, None, "saved", {})
    check_whole(html)
    assert "No surface through the shape: too few points." in words(html)
    assert "<image" not in html


@pytest.mark.parametrize("rows", [[0, 1, 2], [0, 1, 4]], ids=["on one line", "a triangle"])
def test_three_targets(rows: list[int]) -> None:
    joint = joint_of(PLATE)
    per_target = {
        "index",
        "ids",
        "quality",
        *(name for name in vars(joint) if len(np.shape(getattr(joint, name))) and len(getattr(joint, name)) == 12),
    }
    few = replace(joint, **{name: np.asarray(getattr(joint, name))[rows] for name in per_target})
    html = difference_report(difference_of(PLATE, few, surfaces={}), IMAGE, "three", {})
    check_whole(html)
    assert f"Targets compared 3 of {len(PLATE)}" in words(html)


def test_a_picture_of_another_size_is_refused() -> None:
    with pytest.raises(ImageError, match="800x800"):
        difference_report(difference_of(PLATE), IMAGE[1:], "small", {})
