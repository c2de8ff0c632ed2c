"""Run `calibrate cameras` and print boards, for the commands; the mathematics is in `vision/calibration`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from rich.console import Group
from rich.padding import Padding
from rich.text import Text
from scipy.spatial.transform import Rotation

from bodyschema.cli.cameras.board_pages import printed_scale, write_page
from bodyschema.cli.terminal.screen import ruled_table
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray
from bodyschema.interfaces.whole_files import write_atomically
from bodyschema.robot.hand_eye import HandEye, pose_covariance
from bodyschema.vision.board import Board
from bodyschema.vision.board.board import Pattern
from bodyschema.vision.board.page import page as board_page
from bodyschema.vision.calibration.calibrate import Calibrated, CalibrationRequest, calibrate
from bodyschema.vision.calibration.check import Check, check
from bodyschema.vision.calibration.gather import Gathered, gathered, require_both
from bodyschema.vision.calibration.image_pairs import ImagePair, Images, read_pairs, write_pair
from bodyschema.vision.calibration.live import LiveViews
from bodyschema.vision.calibration.refocus import refocused
from bodyschema.vision.calibration.report import page as report_page
from bodyschema.vision.calibration.report.page import NORMAL_95, to_its_interval
from bodyschema.vision.calibration.view import EYES, ONE_EYE
from bodyschema.vision.printing.sheet import rulers_mm
from bodyschema.vision.rig.common_error import CommonError, CommonErrorSettings
from bodyschema.vision.rig.rectified import Rectification
from bodyschema.vision.rig.rig_file import read_rig, write_rig
from bodyschema.vision.rig.stereo_rig import CalibrationError, OneEyeRig, StereoRig

if TYPE_CHECKING:
    from bodyschema.cli.commands.calibrate.calibrate_cameras import KnownCameras

REPORT = "report.html"
_SQUARES = re.compile(r"(\d{1,9})\s*[xX×]\s*(\d{1,9})")

Tell = Callable[[str], None]


class Parameter(msgspec.Struct):
    """A parameter with half the width of its 95 % interval."""

    name: str
    value: float
    half_width: float


class ViewFigures(msgspec.Struct):
    """RMS errors of a view per image coordinate, fitted and held out [px]."""

    name: str
    rms_px: float
    held_out_px: float


class LeftOutView(msgspec.Struct):
    """A view that does not fit the others."""

    name: str
    rms_px: float
    usual_px: float


class UnusableImage(msgspec.Struct):
    name: str
    eye: str
    why: str
    text: str


class CamerasFile(msgspec.Struct):
    """Output of `bodyschema calibrate cameras --json`. Half widths are those of 95 % intervals.

    A single camera has no baseline. Positions are those of a marker of known size all over the view, 0.6 m ahead.
    `right_camera` is the pose of the right optical frame in the left one. `refocused` has a sentence for each sign that
    a lens refocused, or could refocus, between the views.
    """

    model: str
    image_size_px: tuple[int, int]
    serials: tuple[str, ...]
    board: str
    baseline_mm: float | None
    baseline_half_width_mm: float | None
    position_half_widths_mm: tuple[float, float, float]
    reprojection_px: float
    held_out_px: float
    held_out_by_model_px: dict[str, float]
    rectified_focal_px: float
    parameters: list[Parameter]
    views: list[ViewFigures]
    left_out: list[LeftOutView]
    unusable: list[UnusableImage]
    missing: list[str]
    size_was_measured: bool
    right_camera: HandEye | None
    refocused: list[str]
    schema: int = 1


class CheckFile(msgspec.Struct):
    """Output of `bodyschema calibrate cameras --check --json`. Half widths are those of 95 % intervals."""

    holds: bool
    wrong: list[str]
    corners: int
    epipolar_px: float
    rows_px: float
    rows_half_width_px: float
    roll_deg: float
    roll_half_width_deg: float
    square_mm: float
    square_half_width_mm: float
    nominal_mm: float


def board_of(
    squares: str,
    square_mm: float,
    *,
    marker_mm: float | None = None,
    dictionary: str | None = None,
    pattern: Pattern = "charuco",
) -> Board:
    """Return the board described by the options.

    Args:
        squares: columns x rows, for example 8x6.

    Raises:
        ConfigError: the options describe no valid board.
    """
    read = _SQUARES.fullmatch(squares.strip())
    if read is None:
        raise ConfigError(f"--squares {squares} is not as in 8x6", remedy="Give columns x rows, of squares")
    return Board(int(read[1]), int(read[2]), 1e-3 * square_mm, _metres(marker_mm), dictionary, pattern)


def as_printed(nominal: Board, ruler_mm: float | None) -> Board:
    """Return the board as printed: its page's longer ruler measures `ruler_mm`; raise ConfigError if implausible."""
    if ruler_mm is None:
        return nominal
    width, height = nominal.size_m
    scale = printed_scale(rulers_mm((1e3 * width, 1e3 * height))[0], ruler_mm)
    return replace(nominal, square_m=scale * nominal.square_m, marker_m=scale * nominal.marker_side_m)


def write_board(board: Board, paper: str, out: Path) -> tuple[float, float]:
    """Write the board's page as PDF or SVG; return the lengths of its horizontal and vertical ruler [mm].

    Raises:
        ConfigError: it does not fit, the ending is neither, or the file cannot be written.
    """
    return write_page(board_page(board, paper), out)


def from_images(images: Images, board: Board, tell: Tell) -> Gathered:
    """Return all views in a folder's images.

    Raises:
        CalibrationError: there are no pairs, sizes differ, or an eye never sees a usable board.
    """
    files = images.files()
    tell(f"looking for the board in {len(files)} {'images' if images.one else 'pairs of images'}")
    found = gathered(read_pairs(files, side_by_side=images.side_by_side), board, tell)
    require_both(found)
    return found


def calibrated(found: Gathered, known: KnownCameras, tell: Tell, serials: Sequence[str] = ("", "")) -> Calibrated:
    """Calibrate from the views.

    Args:
        serials: serials of the cameras; those in `known` take precedence.

    Raises:
        CalibrationError: the result is not good enough; the message has the reasons.
    """
    known_serials = (known.left_serial, known.right_serial)
    request = CalibrationRequest(
        image_size_px=found.image_size_px,
        serials=tuple(
            known_serial or connected for known_serial, connected in zip(known_serials, serials, strict=False)
        )[: len(found.eyes)],
        date=SystemClock().utc(),
        model=known.lens,
        scale_sigma=0.01 * known.scale_sigma_percent,
        baseline_m=_metres(known.baseline_mm),
    )
    return calibrate(found.views, found.board, request, tell)


def live_views(board: Board, eyes: int) -> LiveViews:
    """Return an empty collection of views of the board, for one eye or two."""
    return LiveViews(board, eyes=EYES if eyes > 1 else ONE_EYE)


def kept_in(folder: Path | None) -> Callable[[ImagePair, int], None]:
    """Return a function that writes the images of a view into `folder`; it does nothing if `folder` is None."""
    return lambda pair, number: None if folder is None else write_pair(pair, folder, number)


def write_calibrated_cameras(result: Calibrated, found: Gathered, out: Path) -> Path:
    """Write cameras.toml with its report beside it, and return the report's path."""
    write_rig(result.rig, out)
    report = out.with_name(f"{out.stem}_{REPORT}")
    write_atomically({report: report_page(result, found).encode()})
    return report


def figures(
    result: Calibrated, found: Gathered, *, size_was_measured: bool, autofocus: Sequence[str] = ()
) -> CamerasFile:
    """Return the figures of a calibration.

    Args:
        autofocus: reports of live cameras on their focus.
        size_was_measured: True if the board, or the distance between the lenses, was measured with a ruler.
    """
    rig, fitted = result.rig, result.fitted
    pair = rig if isinstance(rig, StereoRig) else None
    errors = zip(fitted.views, fitted.bundle.view_rms_px().tolist(), fitted.held_out.view_rms_px.tolist(), strict=True)
    widths = NORMAL_95 * rig.sigma
    across, down, ahead = (1e3 * NORMAL_95 * CommonError(rig).typical).tolist()
    return CamerasFile(
        model=rig.model,
        image_size_px=rig.image_size_px,
        serials=rig.serials,
        board=rig.provenance.board,
        baseline_mm=None if pair is None else 1e3 * pair.baseline_m,
        baseline_half_width_mm=None if pair is None else 1e3 * NORMAL_95 * pair.baseline_sigma_m,
        position_half_widths_mm=(across, down, ahead),
        reprojection_px=rig.provenance.reprojection_px,
        held_out_px=rig.provenance.held_out_px,
        held_out_by_model_px={str(model): px for model, px in result.held_out_by_model_px.items()},
        rectified_focal_px=Rectification(rig).calibration.focal_px,
        parameters=[Parameter(*each) for each in zip(rig.names, rig.vector.tolist(), widths.tolist(), strict=True)],
        views=[ViewFigures(view.name, rms, held_out) for view, rms, held_out in errors],
        left_out=[LeftOutView(each.name, each.rms_px, each.usual_px) for each in fitted.left_out],
        unusable=[UnusableImage(each.name, each.eye, each.fault.why, each.fault.text) for each in found.unusable],
        missing=result.coverage.missing(),
        size_was_measured=size_was_measured,
        right_camera=None if pair is None else _right_camera(pair),
        refocused=[*([] if result.focal_spread is None else [refocused(result.focal_spread)]), *autofocus],
    )


def checked(file: Path, images: Images, board: Board) -> tuple[CheckFile, str]:
    """Check the calibration in `file` with the newest pair that shows the board; return the result and the pair's name.

    Raises:
        ConfigError: the file is damaged.
        CalibrationError: no pair shows the board to both eyes, or the images are of another size.
    """
    rig = pair_in(file)
    files = images.files()
    for pair in reversed(files):
        found = gathered(read_pairs([pair], side_by_side=images.side_by_side), board)
        rig.require(found.image_size_px, rig.serials)
        if found.views and found.views[0].is_stereo:
            return check_figures(check(rig, found.views[0], board)), f"view {pair.name}"
    require_both(gathered(read_pairs(files, side_by_side=images.side_by_side), board))
    raise CalibrationError("no pair of images shows the board to both eyes. Hold it into the middle of both images")


def pair_in(file: Path) -> StereoRig:
    """Return the stereo calibration in `file`; raise CalibrationError if it is of one camera only."""
    rig = read_rig(file)
    if isinstance(rig, OneEyeRig):
        raise CalibrationError(
            f"{file} is of one camera: one look at the board checks two against each other. Calibrate it again to see "
            "whether it changed: `bodyschema calibrate cameras`"
        )
    return rig


def check_figures(found: Check) -> CheckFile:
    return CheckFile(
        holds=found.holds,
        wrong=list(found.wrong),
        corners=found.corners,
        epipolar_px=found.epipolar_px,
        rows_px=found.rows_px,
        rows_half_width_px=NORMAL_95 * found.rows_sigma_px,
        roll_deg=found.roll_deg,
        roll_half_width_deg=NORMAL_95 * found.roll_sigma_deg,
        square_mm=1e3 * found.square_m,
        square_half_width_mm=1e3 * NORMAL_95 * found.square_sigma_m,
        nominal_mm=1e3 * found.nominal_m,
    )


def _right_camera(rig: StereoRig) -> HandEye:
    """Return the pose of the right optical frame in the left one, with its covariance."""

    def pose(values: FloatArray) -> FloatArray:
        R_right_left, t = Rotation.from_rotvec(values[:3]).as_matrix(), values[3:]
        return np.vstack([np.column_stack([R_right_left.T, -R_right_left.T @ t]), [0.0, 0.0, 0.0, 1.0]])

    values = np.concatenate([rig.rotation_rad, rig.translation_m])
    covariance = pose_covariance(pose, values, rig.covariance[-6:, -6:])
    return HandEye.of("left_camera_optical_frame", "right_camera_optical_frame", pose(values), covariance)


def _metres(mm: float | None) -> float | None:
    return None if mm is None else 1e-3 * mm


def cameras_view(found: CamerasFile) -> Group:
    """Return a table of the eyes' parameters, followed by sentences on their accuracy."""
    width, height = found.image_size_px
    eyes = ("left", "right") if found.baseline_mm is not None else ("left",)
    titles = ("left", "95 %", "right", "95 %") if len(eyes) > 1 else ("value", "95 %")
    table = ruled_table(f"{found.model} {'lenses' if len(eyes) > 1 else 'lens'}, {width}x{height}", *titles)
    values = {each.name: each for each in found.parameters}
    own = [name.removeprefix("left.") for name in values if name.startswith("left.")]
    for name in own:
        own_of = (values[f"{eye}.{name}"] for eye in eyes)
        pairs = (to_its_interval(each.value, each.half_width) for each in own_of)
        unit = " [px]" if name.endswith("_px") else ""
        table.add_row(Text(f"{name.removesuffix('_px')}{unit}"), *(text for pair in pairs for text in pair))
    return Group(table, *(Padding(Text(text), (1, 0, 0, 0), expand=False) for text in _sentences(found)))


def check_view(found: CheckFile, name: str) -> Group:
    """Return a table of measured and expected figures, followed by the verdict."""
    table = ruled_table(f"{name}: {found.corners} corners", "measured", "95 %", "should be")
    table.add_row(
        Text("rows of both eyes apart [px]"), f"{found.rows_px:+.3f}", f"± {found.rows_half_width_px:.3f}", "0"
    )
    table.add_row(Text("  RMS of all corners [px]"), f"{found.epipolar_px:.3f}", "", "")
    table.add_row(Text("one eye rolled [°]"), f"{found.roll_deg:+.3f}", f"± {found.roll_half_width_deg:.3f}", "0")
    table.add_row(
        Text("square [mm]"), f"{found.square_mm:.3f}", f"± {found.square_half_width_mm:.3f}", f"{found.nominal_mm:.3f}"
    )
    texts = ["The calibration holds."]
    if not found.holds:
        texts = [
            f"The calibration does not hold: {'; '.join(found.wrong)}.",
            "Put that right, or calibrate again: `bodyschema calibrate cameras`.",
        ]
    return Group(table, *(Padding(Text(text), (1, 0, 0, 0), expand=False) for text in texts))


def _sentences(found: CamerasFile, wishes: int = 3) -> list[str]:
    lines: list[str] = []
    if found.baseline_mm is not None:
        lines.append(f"Baseline {found.baseline_mm:.2f} ± {found.baseline_half_width_mm:.2f} mm (95 %).")
    across, down, ahead = found.position_half_widths_mm
    marker = "Positions" if found.baseline_mm is not None else "Tags of exactly known size"
    lines.append(
        f"{marker} {CommonErrorSettings.ahead_m:g} m ahead are known to ± {across:.2f} mm across, {down:.2f} down, "
        f"{ahead:.2f} in depth (95 %), as far as the calibration goes."
    )
    lines.append(
        f"Views that were not fitted are foretold to {found.held_out_px:.3f} px (RMS per coordinate; fitted "
        f"{found.reprojection_px:.3f}); {len(found.views)} views of {found.board}. {_rivals(found)}"
    )
    lines.extend(f"Warning: {text}." for text in found.refocused)
    if found.left_out:
        names = "; ".join(f"{each.name} ({each.rms_px:.2f} px, others {each.usual_px:.2f})" for each in found.left_out)
        lines.append(f"Left out, since they do not fit the others: {names}.")
    if found.unusable:
        lines.append(f"{len(found.unusable)} images could not be used; the report names them.")
    # The size of the board changes its distance, but not the lens.
    if not found.size_was_measured and found.baseline_mm is not None:
        lines.append(
            "No image shows whether the board has its stated size: measure the line below it and give --ruler-mm, "
            "or the distance of the lenses and give --baseline-mm."
        )
    if found.missing:
        more = "" if len(found.missing) <= wishes else f"; and {len(found.missing) - wishes} more, in the report"
        lines.append(f"It would be better with: {'; '.join(found.missing[:wishes])}{more}.")
    return lines


def _rivals(found: CamerasFile) -> str:
    if len(found.held_out_by_model_px) < 2:
        return ""
    errors = ", ".join(f"{model} {px:.3f} px" for model, px in found.held_out_by_model_px.items())
    return f"Lens models by that error: {errors}."
