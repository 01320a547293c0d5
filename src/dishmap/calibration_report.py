"""The report of a camera's calibration: one HTML page that says first whether the camera is good enough, and what to photograph next."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dishmap.camera.advice import Suggestion
from dishmap.camera.board import BENDS, SHAPE_TERMS
from dishmap.camera.calibrate import Calibration
from dishmap.camera.compare_cameras import Halves
from dishmap.camera.lens_choice import LensChoice
from dishmap.camera.model import Camera
from dishmap.camera.resample import Resampled
from dishmap.page import bullet_list, charts, fact_grid, figure, page, paragraph, section, table, verdict_box
from dishmap.plot.calibration import coverage_map, distortion_map, field_maps, residual_vectors, view_bars
from dishmap.report import calibration_error_section, inputs_section
from dishmap.verdict import number

Array = NDArray[np.float64]

# So many corners left out are listed of a view.
LISTED = 4
# Beyond these a claim is doubted: sampled over predicted error, and focal lengths of two halves in sigmas.
DOUBTFUL_RATIO, DOUBTFUL_SIGMAS = 1.15, 3.0
# A board bent by more than this part of its side is worth a word, if the bend is known to be one (sigmas).
BENT_PART, BENT_SIGMAS = 5e-4, 3.0
SQUARE_PIXELS = "and the pixels of nearly all sensors are square"
MEASURE_PRINT = (
    "are the squares of the board square? Measure its scale along x and along y, and give the file that "
    "`dishmap sheet ... --measured-mm XxY` writes."
)
# Pixels are square to better than this part; beyond it, and so many sigmas, the print is in doubt.
UNEVEN_PART, UNEVEN_SIGMAS = 0.004, 3.0
# Boards and distances outside of these are rather of other units: inches, centimetres, metres.
LIKELY_BOARD_MM, LIKELY_DISTANCE_MM = (25.0, 3000.0), (50.0, 10_000.0)


@dataclass(frozen=True)
class Checks:
    """What was found out about a calibration besides itself; None or empty for what could not be.

    not_found: name of each photograph in which the board was not found or measured, and why.
    """

    choice: LensChoice | None = None
    halves: Halves | None = None
    resampled: Resampled | None = None
    suggestions: tuple[Suggestion, ...] = ()
    not_found: dict[str, str] = field(default_factory=dict)


def calibration_report(
    calibration: Calibration, title: str, checks: Checks, image: NDArray[np.generic] | None = None, inputs: dict[str, str] | None = None
) -> str:
    """The report of a camera's calibration as one HTML page.

    image: one of the photographs (H, W), grey, drawn under the expected errors. inputs: what the camera was made from, by name.
    """
    remarks = remarks_on(calibration, checks)
    body = [
        verdict_box(headline(calibration, checks), bool(remarks)),
        fact_grid(_facts(calibration, checks)),
        section("What to know", bullet_list(remarks)) if remarks else "",
        _next(checks.suggestions),
        calibration_error_section(calibration.camera, image),
        _shapes(calibration, checks),
        _views(calibration),
        _lens(calibration, checks.choice),
        _board(calibration),
        section("Parameters", _parameters(calibration.camera)),
        inputs_section(inputs or {}),
    ]
    return page(title, body)


def headline(calibration: Calibration, checks: Checks) -> str:
    """The calibration in a sentence or two."""
    fit = f"{len(calibration.views)} views fit to {number(calibration.rms_px)} px rms"
    text = f"{fit}; corners cover {calibration.coverage:.0%} of the picture."
    if checks.resampled is not None:
        known = checks.resampled
        across = known.covered_rms_px * known.distance_mm / float(calibration.camera.focal_px.mean())
        text += (
            f" Shapes at {known.distance_mm:.0f} mm are projected to {number(known.covered_rms_px)} px ({number(across)} mm there) where "
            "corners were seen."
        )
    return text


def remarks_on(calibration: Calibration, checks: Checks) -> list[str]:
    """What a user should know before trusting the camera, in sentences."""
    remarks = [*_print_remarks(calibration), *(f"{note[:1].upper()}{note[1:]}." for note in calibration.notes)]
    remarks += [f"{name} was left out: {reason}." for name, reason in (checks.not_found | calibration.rejected).items()]
    for name, corners in calibration.outliers.items():
        more = f" and {len(corners) - LISTED} more" if len(corners) > LISTED else ""
        remarks.append(f"{name}: {len(corners)} corner{'s' * (len(corners) > 1)} left out: {'; '.join(corners[:LISTED])}{more}.")
    weak = [f"{name} ({w:.0%})" for name, w in zip(calibration.view_names, calibration.view_weight, strict=True) if w < 0.5]
    if weak:
        remarks.append(f"Noisier than the other views, and weighed down: {', '.join(weak)}. Were camera or board moving?")
    remarks += _doubts(checks)
    board = calibration.board
    if board.free and (np.abs(board.bend_mm) > BENT_SIGMAS * board.sigma_mm).any() and board.sag_mm > BENT_PART * 2 * board.half_mm:
        remarks.append(f"The board is not flat, by {number(board.sag_mm)} mm from its lowest to its highest point; this was allowed for.")
    return remarks


def _print_remarks(calibration: Calibration) -> list[str]:
    """What camera and board say of the print: squares that are none, sizes in other units."""
    camera, board, remarks = calibration.camera, calibration.board, []
    fx, fy = camera.focal_px
    if camera.covariance is not None:
        slope, stretch = np.array([1 / fx, -1 / fy]), len(BENDS)
        sigma = float(np.sqrt(slope @ camera.covariance[:2, :2] @ slope))
        found = [(f"fx and fy differ by {{}}, {SQUARE_PIXELS}", float(np.log(fx / fy)), sigma)]
        if board.free:
            sides = 2 * board.shape_mm[stretch] / board.half_mm, 2 * float(np.sqrt(board.covariance_mm2[stretch, stretch])) / board.half_mm
            found.append(("The board's squares seem to be {} from square", *sides))
        remarks += [
            f"{said}: ".format(f"{abs(apart):.1%}") + MEASURE_PRINT
            for said, apart, sigma in found
            if abs(apart) > max(UNEVEN_PART, UNEVEN_SIGMAS * sigma)
        ]
    long, short = board_size_mm(calibration)
    near, far = board_distances_mm(calibration)
    if not (LIKELY_BOARD_MM[0] <= long <= LIKELY_BOARD_MM[1] and LIKELY_DISTANCE_MM[0] <= near and far <= LIKELY_DISTANCE_MM[1]):
        remarks.append(
            f"The board would be {_mm(long)}x{_mm(short)} mm, {_mm(near)} to {_mm(far)} mm from the camera; if it was not, its size was "
            "not given in millimetres."
        )
    return remarks


def board_words(calibration: Calibration) -> str:
    """How large the board is and where it stood: a size in other units shows here."""
    long, short = board_size_mm(calibration)
    near, far = board_distances_mm(calibration)
    return f"the board measures {_mm(long)}x{_mm(short)} mm over its corners and stood {_mm(near)} to {_mm(far)} mm from the camera"


def _mm(length: float) -> str:
    return f"{length:.0f}" if length >= 100 else f"{length:.3g}"


def board_size_mm(calibration: Calibration) -> tuple[float, float]:
    """Longer and shorter side of what was seen of the board."""
    sides = np.ptp(np.concatenate([view.board_mm[:, :2] for view in calibration.views]), axis=0)
    return float(sides.max()), float(sides.min())


def board_distances_mm(calibration: Calibration) -> tuple[float, float]:
    """How near and how far along the camera's axis the board's middle was."""
    middle = np.append(calibration.board.middle_mm, 0.0)
    distances = [float(pose.apply(middle)[2]) for pose in calibration.poses]
    return min(distances), max(distances)


def _doubts(checks: Checks) -> list[str]:
    doubts = []
    if checks.resampled is not None and checks.resampled.ratio > DOUBTFUL_RATIO:
        doubts.append(f"Resampling scatters {number(checks.resampled.ratio)} times as much as claimed: take the sigmas that much larger.")
    halves = checks.halves
    if halves is not None and np.abs(halves.focal_sigmas).max() > DOUBTFUL_SIGMAS:
        doubts.append(
            f"Focal lengths from the two halves of the views differ by {number(float(np.abs(halves.focal_sigmas).max()))} sigmas: "
            "was the focus fixed, and the board stiff?"
        )
    return doubts


def _facts(calibration: Calibration, checks: Checks) -> list[tuple[str, str, str]]:
    views, used = calibration.views, np.concatenate(calibration.used)
    left_out = len(checks.not_found | calibration.rejected)
    long, short = board_size_mm(calibration)
    near, far = board_distances_mm(calibration)
    facts = [
        ("Views used", f"{len(views)} of {len(views) + left_out}", f"{int(used.sum())} of {len(used)} corners"),
        ("Rms residual", f"{number(calibration.rms_px)} px", f"length; {number(calibration.rms_px / np.sqrt(2))} px per coordinate"),
        ("Noise of a coordinate", f"{number(calibration.sigma_px)} px", f"sigmas enlarged {number(calibration.inflation)} times"),
        *_nuisances(calibration),
        ("Coverage", f"{calibration.coverage:.0%}", "of the picture held corners"),
        ("Board, mm", f"{_mm(long)}x{_mm(short)}", f"seen {_mm(near)} to {_mm(far)} mm away"),
    ]
    if checks.halves is not None:
        detail = f"rms where both saw corners; largest {number(checks.halves.difference.covered_max_px)} px"
        facts.append(("Two halves differ by", f"{number(checks.halves.difference.covered_rms_px)} px", detail))
    if checks.resampled is not None:
        facts.append(("Sampled over claimed", number(checks.resampled.ratio), f"error of shapes, {checks.resampled.samples} refits"))
    return facts


def _nuisances(calibration: Calibration) -> list[tuple[str, str, str]]:
    """What was found beside noise, in words: errors of the print, and motion while a picture was read."""
    facts = []
    if calibration.board.print_sigma_mm:
        facts.append(("Print", f"{number(calibration.board.print_sigma_mm)} mm", "typical error of a printed coordinate, allowed for"))
    if calibration.motion_sigma_mm:
        detail = f"typical motion while a picture is read by {calibration.readout}, allowed for"
        facts.append(("Motion", f"{number(calibration.motion_sigma_mm)} mm", detail))
    return facts


def _next(suggestions: tuple[Suggestion, ...]) -> str:
    if not suggestions:
        return ""
    words = [
        f"{s.words[:1].upper()}{s.words[1:]}: the expected error over the whole picture falls from {number(s.before_px)} to "
        f"{number(s.after_px)} px."
        for s in suggestions
    ]
    lead = paragraph("What would improve this calibration most, one view on top of the other; left and upper are those of the picture:")
    return section("What to photograph next", lead, bullet_list(words))


def _shapes(calibration: Calibration, checks: Checks) -> str:
    seen = np.concatenate([view.pixels[used] for view, used in zip(calibration.views, calibration.used, strict=True)])
    parts = []
    if (known := checks.resampled) is not None:
        maps = field_maps(
            known.pixels, [("claimed", known.predicted_px), ("sampled", known.sampled_px)], known.covered, "error of shapes (px)", seen
        )
        parts.append(
            figure(
                maps,
                f"Expected error of shapes at {known.distance_mm:.0f} mm: that of projections, without the turn and shift of the camera "
                f"that nothing in its own picture shows. Left, as the covariance claims; right, the scatter of {known.samples} refits "
                f"with new noise, {number(known.ratio)} times the claim. Hatched: no corners, the lens is extrapolated.",
                "Maps of the claimed and the sampled error of shapes.",
            )
        )
    if (halves := checks.halves) is not None:
        difference = halves.difference
        apart = " and ".join(number(float(value)) for value in np.abs(halves.focal_sigmas))
        picture = field_maps(difference.pixels, [("two halves of the views", difference.length_px)], difference.covered, "difference (px)")
        parts.append(
            figure(
                picture,
                f"Difference between the cameras from two halves of the views, at {halves.distance_mm:.0f} mm, their motion removed: "
                f"{number(difference.covered_rms_px)} px rms where both saw corners. Their focal lengths differ by {apart} sigmas (x, y).",
                "Map of the difference between two cameras.",
            )
        )
    return section("How well shapes are known", *parts) if parts else ""


def _views(calibration: Calibration) -> str:
    camera = calibration.camera
    pixels = np.concatenate([view.pixels for view in calibration.views])
    residuals, used = np.concatenate(calibration.residuals_px), np.concatenate(calibration.used)
    bars = figure(
        view_bars(calibration.view_names, calibration.view_rms_px, calibration.rms_px),
        "Root mean square residual of each view. One that stands out was moved, blurred or wrongly found.",
        "Bars of the residual of each view.",
    )
    where = figure(
        coverage_map(pixels, residuals, used, camera.width_px, camera.height_px),
        "All corners, coloured by the length of their residual. Where there are none, the lens is extrapolated.",
        "Map of where corners were seen.",
    )
    vectors = figure(
        residual_vectors(pixels, residuals, used, camera.width_px, camera.height_px),
        "What is left of each corner. Neighbours that point the same way tell of a lens model too lean, of a board that changes its "
        "shape, or of motion while a picture was read.",
        "Lines of the residuals of all corners.",
    )
    return section("Views", charts(bars, where, vectors))


def _lens(calibration: Calibration, choice: LensChoice | None) -> str:
    picture = figure(
        distortion_map(calibration.camera),
        "How far the lens moves what a pinhole camera would see. White: circles about the principal point, as the lens shows them.",
        "Map of the lens distortion.",
    )
    if choice is None:
        return section("Lens", paragraph(f"The lens model {calibration.lens} was asked for."), picture)
    rows = [
        (f"{trial.lens}{' (chosen)' if trial.lens == choice.lens else ''}", number(trial.rms_px), number(trial.held_out_px), trial.problem)
        for trial in choice.trials
    ]
    heads = ("lens model, from lean to rich", "rms of its own views (px)", "typical rms of views held out (px)", "")
    readout = paragraph(f"{choice.readout_reason[:1].upper()}{choice.readout_reason[1:]}.") if choice.readout_reason else ""
    return section("Lens", paragraph(f"{choice.reason}."), table(heads, rows, (0, 3)), readout, picture)


def _board(calibration: Calibration) -> str:
    board = calibration.board
    if not board.free:
        return section("Board", paragraph("The board was taken as flat and printed exactly."))
    sigmas = np.sqrt(np.diag(board.covariance_mm2))
    rows = [
        (name, f"{size:.4f}", number(float(sigma)), "mm")
        for name, size, sigma in zip(SHAPE_TERMS, board.shape_mm, sigmas, strict=True)
        if sigma > 0
    ]
    about = (
        f"Height over a plane at {number(board.half_mm)} mm from the board's middle, along its x and y, positive away from the camera for "
        f"corners and towards it for circles. In all {number(board.sag_mm)} mm from the lowest to the highest point. Stretch and skew "
        "are in the plane: along x longer and along y shorter, and out of square."
    )
    prints = (
        f"Printed points lie {number(board.print_sigma_mm)} mm (sigma of a coordinate) off their places, alike in all views; this was "
        "learnt point by point and allowed for."
        if board.print_sigma_mm
        else "No error of the print itself is seen."
    )
    return section("Board", paragraph(about), paragraph(prints), table(("term", "value", "sigma", "unit"), rows, (0, 3)))


def _parameters(camera: Camera) -> str:
    sigmas = np.full(len(camera.parameters), np.nan) if camera.covariance is None else np.sqrt(np.diag(camera.covariance))
    rows = [
        (name, f"{value:.6g}", number(float(sigma)), "px" if i < 4 else "1")
        for i, (name, value, sigma) in enumerate(zip(camera.parameter_names, camera.parameters, sigmas, strict=True))
    ]
    size = f"{camera.width_px}x{camera.height_px} px, lens model {camera.model}"
    return paragraph(size) + table(("parameter", "value", "sigma", "unit"), rows, (0, 3))
