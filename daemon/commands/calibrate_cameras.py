"""`bodyschema calibrate cameras` and `bodyschema calibrate check`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from daemon.commands.options import (
    BoardDictionary,
    BoardMarkerMm,
    BoardPattern,
    BoardSquares,
    EyeImages,
    LeftImages,
    RightImages,
    RulerMm,
    SideBySide,
    flag,
)

SquareMm = Annotated[float, Parameter(help="Side of a square as drawn [mm].", validator=Number(gt=0))]
CAMERAS = Path("cameras.toml")


def cameras(
    images: EyeImages,
    /,
    *,
    left: LeftImages = None,
    right: RightImages = None,
    side_by_side: SideBySide = False,
    squares: BoardSquares = "8x6",
    square_mm: SquareMm = 30.0,
    marker_mm: BoardMarkerMm = None,
    dictionary: BoardDictionary = None,
    pattern: BoardPattern = "charuco",
    ruler_mm: RulerMm = None,
    baseline_mm: Annotated[
        float | None,
        Parameter(help="Distance of the eyes measured by hand [mm]; refused where the images contradict it."),
    ] = None,
    scale_sigma_percent: Annotated[
        float, Parameter(help="How well the size of a square is known, 1-sigma [%].", validator=Number(gte=0, lt=10))
    ] = 0.1,
    lens: Annotated[
        Literal["auto", "pinhole", "fisheye"], Parameter(help="`auto`: what foretells views better.")
    ] = "auto",
    left_serial: Annotated[str, Parameter(help="What tells the left camera from all others.")] = "",
    right_serial: Annotated[str, Parameter(help="What tells the right camera from all others.")] = "",
    out: Annotated[Path, Parameter(help="The file to write; the report is written beside it.")] = CAMERAS,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Lenses and places of two cameras, from images of the board: writes cameras.toml and a report.

    About 20 pairs, the board held still in each: all over both images, tilted by 20° to 40° each way, near and far.
    Views that do not fit the others are left out and named. It is refused, with the reasons, when it is not good
    enough; what is wrong with the board's size no image can tell, so measure the ruler on the print.

    Needs: images of the board that `bodyschema board` wrote (or of a plain chessboard); no hardware.

    Next: open the report; `bodyschema calibrate check` whenever a camera may have been touched.
    """
    from rich.console import Console

    from daemon.camera_calibration import (
        Images,
        Wanted,
        board_of,
        calibrated,
        figures,
        from_images,
        write_calibrated_cameras,
    )
    from daemon.camera_calibration_view import cameras_view
    from daemon.wire import encode

    board = board_of(squares, square_mm, marker_mm=marker_mm, dictionary=dictionary, pattern=pattern, ruler_mm=ruler_mm)
    wanted = Wanted((left_serial, right_serial), lens, 0.01 * scale_sigma_percent, baseline_mm)
    progress = Console(stderr=True, highlight=False)

    def tell(text: str) -> None:
        progress.print(text, soft_wrap=True, markup=False)

    found = from_images(Images(images, left, right, side_by_side), board, tell)
    result = calibrated(found, wanted, tell)
    report = write_calibrated_cameras(result, found, out)
    if as_json:
        sys.stdout.write(encode(figures(result, found)).decode() + "\n")
        return
    console = Console(highlight=False)
    console.print(cameras_view(figures(result, found)))
    console.print(f"\n{out} written. Open {report}.", markup=False, soft_wrap=True)


def check(
    images: EyeImages,
    /,
    *,
    calibration: Annotated[Path, Parameter(help="The calibration to check.")] = CAMERAS,
    left: LeftImages = None,
    right: RightImages = None,
    side_by_side: SideBySide = False,
    squares: BoardSquares = "8x6",
    square_mm: SquareMm = 30.0,
    marker_mm: BoardMarkerMm = None,
    dictionary: BoardDictionary = None,
    pattern: BoardPattern = "charuco",
    ruler_mm: RulerMm = None,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Whether a calibration still holds, from one look at the board.

    The last pair of images that shows the board to both eyes is taken. A camera that was turned up or down or about
    its line of sight moves the rows apart; one that was turned inwards or outwards changes the size that a square
    seems to have. Exit code 1 when the calibration does not hold.

    Needs: cameras.toml, and a pair of images of the board; no hardware.

    Next: `bodyschema calibrate cameras` again, when it does not hold.
    """
    from rich.console import Console

    from daemon.camera_calibration import Images, board_of, checked
    from daemon.camera_calibration_view import check_view
    from daemon.wire import encode

    board = board_of(squares, square_mm, marker_mm=marker_mm, dictionary=dictionary, pattern=pattern, ruler_mm=ruler_mm)
    found, name = checked(calibration, Images(images, left, right, side_by_side), board)
    if as_json:
        sys.stdout.write(encode(found).decode() + "\n")
    else:
        Console(highlight=False).print(check_view(found, name))
    if not found.holds:
        sys.exit(1)
