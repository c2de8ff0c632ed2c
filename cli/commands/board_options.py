"""Command-line options for the calibration board and for images of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import flag

if TYPE_CHECKING:
    from bodyschema.cli.cameras.calibration import Board, Images


@Parameter(name="*")
@dataclass(frozen=True)
class PrintedBoard:
    """The board: as its page was written, and as it came out of the printer."""

    squares: Annotated[str, Parameter(help="Columns and rows of the board's squares, as in 8x6.")] = "8x6"
    square_mm: Annotated[float, Parameter(help="Nominal side of a square [mm].", validator=Number(gt=0))] = 30.0
    marker_mm: Annotated[
        float | None, Parameter(help="Side of a marker [mm]; else 0.75 of a square.", show_default=False)
    ] = None
    dictionary: Annotated[
        str | None,
        Parameter(help="The markers' dictionary, as in 5X5_100; else the smallest of 4x4 bits.", show_default=False),
    ] = None
    pattern: Annotated[
        Literal["charuco", "chessboard"],
        Parameter(help="`chessboard` has no markers; all of it has to be in view."),
    ] = "charuco"

    ruler_mm: Annotated[
        float | None,
        Parameter(
            help="What the line below the board measures on the print [mm]; else it is what it says.",
            validator=Number(gt=0),
            show_default=False,
        ),
    ] = None

    def drawn(self) -> Board:
        """Return the board in its nominal size. Raise ConfigError if the options describe no valid one."""
        from bodyschema.cli.cameras.calibration import board_of

        return board_of(
            self.squares,
            self.square_mm,
            marker_mm=self.marker_mm,
            dictionary=self.dictionary,
            pattern=self.pattern,
        )

    def board(self) -> Board:
        """Return the board in its printed size. Raise ConfigError if the options describe no valid one."""
        from bodyschema.cli.cameras.calibration import as_printed

        return as_printed(self.drawn(), self.ruler_mm)


@Parameter(name="*")
@dataclass(frozen=True)
class EyeFiles:
    """Which of a folder's images are which eye's."""

    left: Annotated[str | None, Parameter(help="Pattern of the left eye's files in it, as in cam0_*.png.")] = None
    right: Annotated[str | None, Parameter(help="Pattern of the right eye's.")] = None
    side_by_side: Annotated[bool, flag("Each image shows both eyes, the left one in its left half.")] = False
    one: Annotated[bool, flag("All images are of one camera alone; --left may select them in the folder.")] = False

    def of(self, folder: Path) -> Images:
        """Return the images in `folder` that these options select."""
        from bodyschema.cli.cameras.calibration import Images

        return Images(folder, self.left, self.right, self.side_by_side, self.one)


AS_PRINTED, BY_NAME = PrintedBoard(), EyeFiles()

EyeImages = Annotated[
    Path | None,
    Parameter(
        help="Folder with the images: left01.png and right01.png, or left/ and right/; else the robot's own cameras."
    ),
]
