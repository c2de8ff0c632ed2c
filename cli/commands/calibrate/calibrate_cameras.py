"""`bodyschema calibrate cameras`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.options import (
    AS_PRINTED,
    BY_NAME,
    HERE,
    EyeFiles,
    EyeImages,
    PrintedBoard,
    RobotFile,
    flag,
    print_json,
    say,
)
from bodyschema.daemon.service.signals import on_termination
from bodyschema.interfaces.clock import SystemClock

if TYPE_CHECKING:
    from bodyschema.cli.cameras.calibration import Board, Calibrated, CheckFile, Gathered
    from bodyschema.daemon.config import Config

CAMERAS, BOARD = Path("cameras.toml"), Path("board.pdf")


@Parameter(name="*")
@dataclass(frozen=True)
class KnownCameras:
    """Prior knowledge of the cameras."""

    baseline_mm: Annotated[
        float | None,
        Parameter(help="Distance of the eyes measured by hand [mm]; refused where the images contradict it."),
    ] = None
    scale_sigma_percent: Annotated[
        float, Parameter(help="How well the size of a square is known, 1-sigma [%].", validator=Number(gte=0, lt=10))
    ] = 0.1
    lens: Annotated[
        Literal["auto", "pinhole", "fisheye", "rational"], Parameter(help="`auto`: what foretells views better.")
    ] = "auto"
    left_serial: Annotated[
        str,
        Parameter(help="Serial number of the left camera, kept in the file; live, it is known.", show_default=False),
    ] = ""
    right_serial: Annotated[str, Parameter(help="Serial number of the right camera.", show_default=False)] = ""


@Parameter(name="*")
@dataclass(frozen=True)
class Instead:
    """Actions instead of a calibration."""

    check: Annotated[bool, flag("Check that a calibration still holds, from one look at the board.")] = False
    calibration: Annotated[
        Path | None, Parameter(help="With --check: the calibration; else cameras.toml, live the one in robot.toml.")
    ] = None
    seconds: Annotated[
        float, Parameter(help="With --check, live: how long the board is waited for [s].", validator=Number(gt=0))
    ] = 60.0
    print_board: Annotated[bool, flag("Write the board as a page to print, OUT.pdf or OUT.svg, and end.")] = False
    paper: Annotated[str, Parameter(help="Of --print-board: A4, A3, A2, A1, A0, letter, legal or tabloid.")] = "A4"


UNKNOWN, CALIBRATE = KnownCameras(), Instead()


def cameras(
    images: EyeImages = None,
    /,
    *,
    robot: RobotFile = HERE,
    files: EyeFiles = BY_NAME,
    printed: PrintedBoard = AS_PRINTED,
    known: KnownCameras = UNKNOWN,
    save: Annotated[
        Path | None, Parameter(help="Live: keep the images of all views in this folder, as IMAGES has them.")
    ] = None,
    out: Annotated[
        Path | None,
        Parameter(help="The file to write, with a report beside it; else cameras.toml, live beside robot.toml."),
    ] = None,
    instead: Instead = CALIBRATE,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Calibrate two cameras, or the lens of one, from views of a board: writes cameras.toml and a report.

    Use about 20 pairs of images, or 20 images of a single camera (--one), with the board held still in each: all over
    the images, tilted by 20° to 40° each way, near and far. Without IMAGES the robot's own cameras are used: the
    command says what to show next, and takes a view as soon as the board is still and the view is new. It ends when the
    calibration is good enough, or with Ctrl-C. Views that do not fit the others are left out and named. A calibration
    that is not good enough is refused, with the reasons. No image shows an error of the board's size, so measure the
    ruler on the print. (A single camera does not need the size.)

    --print-board writes the board in true size to --out, by default board.pdf. Print it at 100 % ("actual size"),
    measure the two rulers on the page, and glue the sheet onto something flat and stiff: glass, aluminium, thick board.
    A bent sheet gives a wrong calibration that looks like a good one. Calibrate with the same options; add --ruler-mm
    if a ruler does not have its stated length.

    --check takes the last pair of images that shows the board to both eyes; without IMAGES it waits until the robot's
    own cameras see the board held still. A camera that was tilted up or down, or rotated about its line of sight, moves
    the rows apart; one that was turned inwards or outwards changes the apparent size of a square. Exit code 1 if the
    calibration no longer holds.

    Needs: the printed board (or a plain chessboard), and images of it, no hardware; or robot.toml with cameras, and no
    running sampler.

    Next: open the report; `bodyschema calibrate cameras --check` whenever a camera may have been touched.
    """
    if instead.print_board:
        _print_board(printed.nominal_board(), instead.paper, out or BOARD)
    elif instead.check:
        _check(images, files, printed, robot, instead, as_json=as_json)
    else:
        _calibrate(images, files, printed, robot, known, save, out, as_json=as_json)


def _calibrate(
    images: Path | None,
    files: EyeFiles,
    printed: PrintedBoard,
    robot: Path,
    known: KnownCameras,
    save: Path | None,
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    from bodyschema.cli.cameras.calibration import (
        calibrated,
        cameras_view,
        figures,
        from_images,
        write_calibrated_cameras,
    )
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.cameras import calibration_file, require_cameras

    board, named, autofocus = printed.board(), True, ()
    if images is not None:
        tell = partial(say, stderr=True)
        found = from_images(files.of(images), board, tell)
        result, out = calibrated(found, known, tell), out or CAMERAS
    else:
        config = Config.load(robot)
        found, result, autofocus = _live(config, board, known, save)
        out, named = out or calibration_file(config), require_cameras(config).calibration is not None
    report = write_calibrated_cameras(result, found, out)
    measured = printed.ruler_mm is not None or known.baseline_mm is not None
    summary = figures(result, found, size_was_measured=measured, autofocus=autofocus)
    if as_json:
        print_json(summary)
        return
    Console(highlight=False).print(cameras_view(summary))
    say(f"\n{out} written. Open {report}.")
    if not named:
        say(f'In [vision.cameras] write\ncalibration = "{out.name}"')


def _check(
    images: Path | None, files: EyeFiles, printed: PrintedBoard, robot: Path, instead: Instead, *, as_json: bool
) -> None:
    from bodyschema.cli.cameras.calibration import check_view, checked
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.cameras import calibration_file

    board = printed.board()
    if images is not None:
        found, name = checked(instead.calibration or CAMERAS, files.of(images), board)
    else:
        config = Config.load(robot)
        found, name = _checked_live(config, instead.calibration or calibration_file(config), board, instead.seconds)
    if as_json:
        print_json(found)
    else:
        Console(highlight=False).print(check_view(found, name))
    if not found.holds:
        sys.exit(1)


def _print_board(made: Board, paper: str, out: Path) -> None:
    from bodyschema.cli.cameras.calibration import write_board

    across, upright = write_board(made, paper, out)
    say(
        f"{out} written: {made.name}. Print it at 100 %, then measure both rulers: {across:g} mm below, {upright:g} mm "
        "beside the board."
    )


def _live(
    config: Config, board: Board, known: KnownCameras, save: Path | None
) -> tuple[Gathered, Calibrated, tuple[str, ...]]:
    """Return the views, their calibration, and the cameras' reports on their focus."""
    from bodyschema.cli.cameras.calibration import calibrated, kept_in, live_views
    from bodyschema.cli.cameras.live_calibration import LiveCalibration, guidance_on
    from bodyschema.daemon.wiring.cameras import focus_complaints, open_eyes, require_cameras

    clock = SystemClock()
    eyes = open_eyes(config, clock)
    views = live_views(board, require_cameras(config).eyes)
    with guidance_on(Console(stderr=True, highlight=False), board.name, clock) as show:
        calibration = LiveCalibration(
            eyes,
            views,
            lambda found, serials, tell: calibrated(found, known, tell, serials),
            show,
            clock,
            keep=kept_in(save),
        )
        with on_termination(calibration.stop):
            found, result = calibration.run()
    return found, result, focus_complaints(eyes)


def _checked_live(config: Config, file: Path, board: Board, seconds: float) -> tuple[CheckFile, str]:
    from bodyschema.cli.cameras.calibration import check_figures
    from bodyschema.cli.cameras.live_calibration import LiveViews, checked_live, guidance_on
    from bodyschema.daemon.wiring.cameras import open_eyes

    clock = SystemClock()
    with guidance_on(Console(stderr=True, highlight=False), board.name, clock) as show:
        found = checked_live(open_eyes(config, clock), file, LiveViews(board), show, clock, seconds)
    return check_figures(found), "now"
