"""The report: says what was measured, needs nothing but itself, and lets no text of the user become part of the page."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from dishmap.calibration_report import Checks, calibration_report
from dishmap.camera.board import SHAPE_TERMS, BoardShape, BoardView
from dishmap.camera.calibrate import Calibration
from dishmap.camera.model import Camera
from dishmap.errors import ImageError
from dishmap.page import script_json
from dishmap.pipeline import Map, map_photograph
from dishmap.quality import Quality
from dishmap.report import map_report
from dishmap.simulate.render import simulate
from dishmap.simulate.scene import Disc, Scene, Sensor, facing_pose
from dishmap.surface.cloud import select_points
from dishmap.targets.builders import dish, plate
from dishmap.targets.identify import Upright
from dishmap.transforms import Pose
from dishmap.verdict import common_reasons, number, numbers_of, rows_of_reasons, verdict_of

# plotly.js itself is 4.8 MB.
LARGEST_BYTES = 6_000_000
HOSTILE = "\"><script>alert(1)</script>&'.png"
VOID = {"meta", "img"}
# Slopes by differences against the analytic ones, radians: far below any sigma of a normal.
SLOPE_ERROR_RAD = 1e-6


@dataclass
class Page(HTMLParser):
    """What a browser would see of a page."""

    attributes: list[tuple[str, str, str]] = field(default_factory=list)
    stack: list[str] = field(default_factory=list)
    scripts: list[str] = field(default_factory=list)
    text: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag, f"</{tag}> closes another element"

    def handle_data(self, data: str) -> None:
        if self.stack and self.stack[-1] == "script":
            self.scripts.append(data)
        elif self.stack and self.stack[-1] not in ("style",):
            self.text.append(data)
            if self.stack[-1] in ("td", "th"):
                self.rows[-1][-1] += data


def parsed(html: str) -> Page:
    page = Page()
    page.feed(html)
    page.close()
    assert not page.stack
    return page


def words(html: str) -> str:
    return " ".join(" ".join(parsed(html).text).split())


@dataclass(frozen=True)
class Shot:
    image: np.ndarray
    result: Map


def shot_of(scene: Scene, seed: int = 5, method: str = "pose") -> Shot:
    image = simulate(scene, np.random.default_rng(seed)).image
    return Shot(image, map_photograph(image, scene.camera, scene.pattern, Upright(), method))


COVARIANCE = np.diag([0.3, 0.3, 0.2, 0.2]) ** 2
CAMERA = Camera(640, 480, [800.0, 800.0], [319.5, 239.5], covariance=COVARIANCE)
PLATE_POSE = facing_pose(420.0, 0.2, 0.4)
COVERED_MM = (-75.0, -50.0)


@pytest.fixture(scope="module")
def flat() -> Shot:
    """A tilted plate of 12 targets; the camera has a covariance."""
    return shot_of(Scene(plate(3, 4, 50), CAMERA, PLATE_POSE, sensor=Sensor(noise_grey=1.5)))


@pytest.fixture(scope="module")
def hidden() -> Shot:
    """A plate with one target covered; the camera has no covariance."""
    u, v = CAMERA.project(PLATE_POSE.apply([[*COVERED_MM, 0.0]]))[0]
    camera = Camera(640, 480, [800.0, 800.0], [319.5, 239.5])
    scene = Scene(plate(3, 4, 50), camera, PLATE_POSE, sensor=Sensor(noise_grey=1.5), occluders=(Disc((u, v), 32.0, 90.0),))
    return shot_of(scene)


@pytest.fixture(scope="module")
def flat_html(flat: Shot) -> str:
    return map_report(flat.result, flat.image, HOSTILE, {"photograph": HOSTILE, HOSTILE: "camera.yaml"})


def test_the_page_says_what_was_measured(flat: Shot, flat_html: str) -> None:
    said = words(flat_html)
    fit = flat.result.surface
    assert fit is not None
    assert f"All 12 targets measured; the plane fits to {number(fit.rms_mm)} mm rms." in said
    sigma = np.sqrt(flat.result.cloud.covariance_mm2[:, 2, 2])
    assert f"{number(float(np.median(sigma)))} mm" in said
    assert f"{number(float(sigma.min()))} to {number(float(sigma.max()))} mm" in said
    assert "covariance is unknown" not in said


def test_the_table_holds_every_target(flat: Shot, flat_html: str) -> None:
    rows = {row[0]: row for row in parsed(flat_html).rows if len(row) == 13}
    cloud = flat.result.cloud
    for n, ident in enumerate(cloud.ids):
        shown = np.array([float(cell) for cell in rows[str(ident)][1:9]])
        expected = np.concatenate([cloud.position_mm[n], cloud.normal[n], cloud.center_px[n]])
        # half of the last digit shown
        assert np.abs(shown - expected).max() <= 0.00051


def test_the_page_needs_nothing_else(flat_html: str) -> None:
    assert len(flat_html.encode()) < LARGEST_BYTES
    for tag, name, value in parsed(flat_html).attributes:
        if name in ("src", "href", "xlink:href", "action", "data", "poster", "srcset"):
            assert value.startswith("data:"), f"{tag} refers to {value[:60]}"
    policy = next(value for tag, name, value in parsed(flat_html).attributes if name == "content" and "default-src" in value)
    assert "default-src 'none'" in policy
    assert "http" not in policy
    styles = re.findall(r"<style>(.*?)</style>", flat_html, flags=re.DOTALL)
    assert all("url(" not in style and "@import" not in style for style in styles)


def test_pictures_have_words(flat_html: str) -> None:
    page = parsed(flat_html)
    images = [i for i, (tag, name, _) in enumerate(page.attributes) if tag == "img" and name == "src"]
    alts = [value for tag, name, value in page.attributes if tag == "img" and name == "alt"]
    assert len(images) == len(alts) >= 4
    assert all(len(alt) > 10 for alt in alts)
    pictures = [name for tag, name, _ in page.attributes if tag == "svg" and name == "aria-label"]
    assert len(pictures) == 2
    assert ("html", "lang", "en") in page.attributes


def test_text_of_the_user_stays_text(flat_html: str) -> None:
    page = parsed(flat_html)
    assert not any("alert" in script for script in page.scripts[-1:])
    assert "<script>alert" not in flat_html
    assert [HOSTILE, "camera.yaml"] in page.rows
    assert ["photograph", HOSTILE] in page.rows
    assert script_json(["</script><!--\u2028"]) == '["\\u003c/script>\\u003c!--\\u2028"]'


def test_the_same_map_gives_the_same_page(flat: Shot, flat_html: str) -> None:
    again = map_report(flat.result, flat.image, HOSTILE, {"photograph": HOSTILE, HOSTILE: "camera.yaml"})
    assert again == flat_html


def scene_of(html: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    call = parsed(html).scripts[-1].strip()
    assert call.startswith('Plotly.newPlot("surface3d",')
    arguments = json.loads("[" + call[call.index("(") + 1 : call.rindex(")")] + "]")
    return arguments[1], arguments[2]


def test_the_3d_picture_shows_points_and_surface(flat: Shot, flat_html: str) -> None:
    traces, layout = scene_of(flat_html)
    surface, _, enlarged, _, true = traces
    in_dish = flat.result.camera_from_dish.inverse().apply(flat.result.cloud.position_mm)
    assert np.column_stack([true["x"], true["y"], true["z"]]) == pytest.approx(in_dish, abs=1e-3)
    fit = flat.result.surface
    assert fit is not None
    factor = (np.array(enlarged["z"]) - np.array(true["z"])) / fit.residual_mm + 1
    clear = np.abs(fit.residual_mm) > 0.3 * np.abs(fit.residual_mm).max()
    assert factor[clear] == pytest.approx(np.full(clear.sum(), np.median(factor[clear])), rel=0.05)
    assert f"{np.median(factor[clear]):.0f} times enlarged" in layout["updatemenus"][0]["buttons"][0]["label"]
    # the plane is that of the fit
    height, slope_x, slope_y = fit.coefficients
    x, y, z = (np.array(surface[name], dtype=float) for name in "xyz")
    cx, cy = fit.basis.center_mm or (0.0, 0.0)
    assert z == pytest.approx(height + slope_x * (x - cx) + slope_y * (y - cy), abs=0.01)
    assert np.ptp(x) == pytest.approx(np.ptp(in_dish[:, 0]), rel=0.05)
    assert f"target {flat.result.cloud.ids[3]}<br>" in true["text"][3]
    assert "sigma" in true["text"][3]


def test_ratio_of_residuals_to_sigmas(flat: Shot) -> None:
    numbers, fit = numbers_of(flat.result), flat.result.surface
    assert fit is not None
    assert numbers.ratio is not None
    along = np.array([-fit.coefficients[1], -fit.coefficients[2], 1.0])
    covariance = numbers.dish.covariance_mm2
    assert numbers.ratio == pytest.approx(fit.residual_mm / np.sqrt(along @ covariance @ along), rel=1e-4)


def test_normals_of_a_paraboloid_are_its_gradients() -> None:
    camera = Camera(900, 900, [700.0, 700.0], [449.5, 449.5])
    shot = shot_of(Scene(dish(300, 150, spacing_mm=60), camera, facing_pose(420.0), sensor=Sensor(noise_grey=1.0)))
    result = shot.result
    fit = result.surface
    assert fit is not None
    assert fit.basis.kind == "paraboloid"
    numbers = numbers_of(result)
    vertex, axis, focal = fit.coefficients[:3], fit.coefficients[3:6], fit.coefficients[6]
    # gradient of |p|^2 - (a p)^2 - 4 f (a p), p from the vertex, at the surface above each target's x, y
    xy = numbers.dish.position_mm[:, :2]
    p = np.column_stack([xy, numbers.dish.position_mm[:, 2]]) - vertex
    for _ in range(20):
        along = p @ axis
        value = (p**2).sum(axis=1) - along**2 - 4 * focal * along
        gradient = 2 * p - 2 * along[:, None] * axis - 4 * focal * axis
        p[:, 2] -= value / gradient[:, 2]
    normal = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    assert numbers.lean_rad == pytest.approx((numbers.dish.normal - normal)[:, :2], abs=SLOPE_ERROR_RAD)
    assert "the paraboloid fits to" in words(map_report(result, shot.image, "dish", {}))


def test_what_is_missing_or_strange_is_told(hidden: Shot) -> None:
    result = hidden.result
    at = result.pattern.center_mm[:, :2]
    covered = int(result.pattern.ids[np.argmin(np.linalg.norm(at - COVERED_MM, axis=1))])
    assert set(result.missing) | {i for i, _ in result.rejected if i is not None} == {covered}
    strange = np.where(result.cloud.ids == result.cloud.ids[5], int(Quality.OFF_SURFACE | Quality.GLARE), 0)
    result = replace(result, cloud=replace(result.cloud, quality=strange))
    html = map_report(result, hidden.image, "hidden", {})
    said = words(html)
    assert "11 of 12 targets measured; 1 " in said
    assert f"1 target flagged off_surface ({result.cloud.ids[5]}): the target lies, or moved, far from the surface" in said
    assert f"1 target flagged glare ({result.cloud.ids[5]}): " in said
    assert "10 of 11 targets measured are clean" in said
    assert "covariance is unknown" in said
    assert "Not known: the camera file carries no covariance." in said


def test_rejections_and_their_reasons_are_told(flat: Shot) -> None:
    cut = replace(flat.result, cloud=select_points(flat.result.cloud, np.arange(10)), poses=replace_index(flat.result, np.arange(10)))
    cut = replace(cut, surface=None, surface_problem="too <few>", rejected=((10, "it is <cut>"), (None, "a stray ring")), missing=(11,))
    html = map_report(cut, flat.image, "cut", {})
    said = words(html)
    assert "10 of 12 targets measured; 1 seen but rejected, 1 not seen; no surface could be fitted." in said
    assert "1 target seen but rejected: it is <cut> (10)." in said
    assert "1 target not seen: 11." in said
    assert "No surface: too <few>." in said
    assert ["10", "it is <cut>"] in parsed(html).rows
    assert ["1 without id", "a stray ring"] in parsed(html).rows
    assert "Plotly" not in html


def replace_index(result: Map, keep: np.ndarray) -> Any:
    return replace(result.poses, index=result.poses.index[keep])


def test_one_target_without_a_surface(flat: Shot) -> None:
    one = replace(
        flat.result,
        cloud=select_points(flat.result.cloud, np.array([4])),
        poses=replace_index(flat.result, np.array([4])),
        surface=None,
        surface_problem="1 target is too few",
        missing=tuple(int(i) for i in flat.result.pattern.ids if i != flat.result.cloud.ids[4]),
    )
    assert "1 of 12 targets measured; 11 not seen; no surface could be fitted." in words(map_report(one, flat.image, "one", {}))


def test_points_exactly_on_the_surface(flat: Shot) -> None:
    fit = flat.result.surface
    assert fit is not None
    exact = replace(flat.result, surface=replace(fit, residual_mm=np.zeros(12), rms_mm=0.0, noise_factor=0.0))
    html = map_report(exact, flat.image, "exact", {})
    assert "the plane fits to 0 mm rms" in words(html)
    assert scene_of(html)[1]["updatemenus"][0]["buttons"][0]["label"] == "residuals 1 times enlarged"


def test_surfaces_with_shape_are_told_from_noise(flat: Shot) -> None:
    fit = flat.result.surface
    assert fit is not None
    numbers = numbers_of(flat.result)
    rough = verdict_of(replace(flat.result, surface=replace(fit, noise_factor=12.0, converged=False)), numbers)
    assert any(w.startswith("Residuals are 12.0 times what the claimed sigmas allow") for w in rough.warnings)
    assert any("did not converge" in w for w in rough.warnings)
    plain = verdict_of(replace(flat.result, surface=replace(fit, noise_factor=1.1)), numbers)
    assert not plain.warnings


def test_the_method_of_the_paper_has_no_sigmas() -> None:
    shot = shot_of(Scene(plate(3, 4, 50), CAMERA, PLATE_POSE, sensor=Sensor(noise_grey=1.5)), method="paper")
    html = map_report(shot.result, shot.image, "paper", {})
    said = words(html)
    assert "The paper's method gives no uncertainty" in said
    assert "Depth sigma" not in said
    assert "σ z" not in said
    assert "sigma" not in scene_of(html)[0][-1]["text"][0]


def test_a_picture_of_another_size_is_refused(flat: Shot) -> None:
    with pytest.raises(ImageError, match=r"shape \(480, 600\) but the map was made from one of 640x480 px; give the photograph"):
        map_report(flat.result, flat.image[:, :600], "a", {})


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.02345, "0.0234"), (1.0, "1.00"), (123.4, "123"), (-0.5, "-0.500"), (1e-7, "1.00e-07"), (2e7, "2.00e+07")],
)
def test_numbers_are_written_with_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_the_report_of_a_calibration() -> None:
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    views = tuple(BoardView(f"<{i}>", 100 + 60 * grid + 20 * i, np.column_stack([10 * grid, np.zeros(20)])) for i in range(4))
    residuals = tuple(rng.normal(size=(20, 2)) * 0.1 for _ in views)
    rms = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in residuals])
    calibration = Calibration(
        camera=CAMERA,
        views=views,
        poses=(Pose.identity(),) * 4,
        used=(np.ones(20, dtype=bool),) * 4,
        residuals_px=residuals,
        view_rms_px=rms,
        rms_px=float(np.sqrt((rms**2).mean())),
        sigma_px=0.1,
        inflation=1.2,
        coverage=0.43,
        rejected={"<bad>": "it is <blurred>"},
        notes=("few views",),
        lens="opencv5",
        view_weight=np.ones(4),
        board=BoardShape(np.zeros(2), 50.0, np.zeros(len(SHAPE_TERMS)), np.eye(len(SHAPE_TERMS)), np.zeros((1, 3)), np.zeros((1, 2)), 0.03),
        expected=CAMERA.parameters,
        independent=1.0,
        readout="columns",
        motion=np.ones((4, 6)),
        motion_sigma_mm=0.4,
    )
    html = calibration_report(calibration, HOSTILE, Checks())
    said = words(html)
    assert f"4 views fit to {number(calibration.rms_px)} px rms; corners cover 43% of the picture." in said
    assert "<bad> was left out: it is <blurred>." in said
    assert "Few views." in said
    assert "Printed points lie 0.0300 mm (sigma of a coordinate) off their places" in said
    assert "typical motion while a picture is read by columns, allowed for" in said
    assert ["fx", "800", "0.300", "px"] in parsed(html).rows
    assert "this radius is an expected error of" in said
    assert calibration_report(calibration, HOSTILE, Checks()) == html


def test_many_reasons_are_told_briefly() -> None:
    few = [(1, "glare"), (2, "glare"), (3, "clipped")]
    assert common_reasons(few) == (["glare", "clipped"], [])
    many = [*few, *((10 + k, f"it lies {k} px off") for k in range(8))]
    usual, others = common_reasons(many)
    assert usual[:2] == ["glare", "clipped"]
    assert len(usual) == 5
    # whoever is told already is not among the others
    assert others == [13, 14, 15, 16, 17]
    assert rows_of_reasons(few) == [("1", "glare"), ("2", "glare"), ("3", "clipped")]
    assert rows_of_reasons([*many, (20, "glare"), (21, "glare")])[0] == ("1, 2, 20, 21", "glare")
