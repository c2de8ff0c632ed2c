"""Options that several commands share."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

if TYPE_CHECKING:
    from bodyschema.cli.cameras.calibration import Board, Images
    from bodyschema.cli.recordings.diagnosis import DiagnosisSettings
    from bodyschema.daemon.config import Config


HERE = Path("robot.toml")
VARIABLE = "BODYSCHEMA_ROBOT"
RobotFile = Annotated[Path, Parameter(env_var=VARIABLE, help="The robot's description.")]

SourceRobotFile = Annotated[
    Path | None, Parameter(show_default=False, help=f"robot.toml; else the one beside the source, {VARIABLE}, or here.")
]


DatasetCalibration = Annotated[
    Path | None,
    Parameter(name="--lerobot", help="Of a dataset: LeRobot's calibration file of the arm it was recorded with."),
]


@Parameter(name="*")
@dataclass(frozen=True)
class SourceOptions:
    """Parts of a ROS bag or a LeRobotDataset to read."""

    joint_topic: Annotated[str | None, Parameter(help="Of a bag: the topic with the joint states.")] = None
    marker_topic: Annotated[str | None, Parameter(help="Of a bag: the topic with the marker's positions.")] = None
    marker_frame: Annotated[str | None, Parameter(help="Of a bag: the marker's frame, where it comes by TF.")] = None
    markers: Annotated[
        Path | None, Parameter(help="Of a bag or a dataset: a file with the marker's positions (t, x, y, z).")
    ] = None
    video: Annotated[
        str | None,
        Parameter(
            help="Track the marker in a camera's pictures: of a dataset such as observation.images.front, of a bag the "
            "topic of its compressed images."
        ),
    ] = None
    lerobot_unit: Annotated[
        Literal["degrees", "range_m100_100"] | None,
        Parameter(help="Of a dataset: the unit of its readings, where they do not show it."),
    ] = None

    marker_delay_ms: Annotated[
        float,
        Parameter(
            help="Of a bag or a dataset: how late the marker's positions are stamped [ms].",
            validator=Number(gte=-10_000, lte=10_000),
        ),
    ] = 0.0


AS_THEY_ARE = SourceOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class SearchOptions:
    """Effects that a diagnosis looks for, and its seed."""

    effects: Annotated[str | None, Parameter(help="Look for these alone, as in backlash,joint_offset.")] = None
    exclude: Annotated[str | None, Parameter(help="Do not look for these.")] = None
    seed: Annotated[int, Parameter(help="Of the resampling behind the intervals.", validator=Number(gte=0))] = 0

    def settings(self) -> DiagnosisSettings:
        """Return the effects to look for; raise RequestError for an unknown one."""
        from bodyschema.cli.recordings.diagnosis import DiagnosisSettings

        return DiagnosisSettings.of(self.effects, self.exclude, self.seed)


ANYTHING = SearchOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class LeRobotOptions:
    """LeRobot's calibration file, as a target of the joint offsets found."""

    lerobot: Annotated[
        Path | None,
        Parameter(
            name="--lerobot", help="LeRobot's calibration file: show its homing offsets with the joint offsets found."
        ),
    ] = None
    write: Annotated[
        bool,
        Parameter(help="Write the file of --lerobot; the old one is kept beside it.", negative="", show_default=False),
    ] = False

    def require(self, config: Config) -> None:
        """Raise ConfigError if a file is given but joint offsets could not be written to it."""
        from bodyschema.cli.hardware.lerobot_robot import CorrectedCalibration

        if self.lerobot is not None:
            CorrectedCalibration.of(config, self.lerobot, {})

    def lines(self, config: Config, offsets_rad: Mapping[str, float], recording: Path | None) -> list[str]:
        """Return the changes of the file by joint offsets, after writing it if requested; nothing without a file.

        If the file already contains the offsets of this `recording`, nothing is written, and the lines report it.
        """
        from bodyschema.cli.hardware.lerobot_robot import CorrectedCalibration, after_writing, difference

        if self.lerobot is None:
            return []
        corrected = CorrectedCalibration.of(config, self.lerobot, offsets_rad)
        if already_written := corrected.already_written(recording):
            return already_written
        lines = difference(corrected)
        if not any(change.ticks for change in corrected.changes):
            return lines
        written = after_writing(corrected.write(recording)) if self.write else "Nothing is written without --write."
        return [*lines, written]


WITHOUT_LEROBOT = LeRobotOptions()


def flag(text: str, *, name: str | None = None) -> Parameter:
    """Return an option without a value, off by default."""
    return Parameter(name=name, help=text, negative="", show_default=False)


def say(*lines: str, stderr: bool = False) -> None:
    """Return a function that prints lines unchanged: neither wrapped nor read as markup."""
    console = Console(stderr=stderr, highlight=False, soft_wrap=True)
    for line in lines:
        console.print(line, markup=False)


def print_json(value: object) -> None:
    """Print `value` as a JSON object on one line, with the key `schema` for the version of its keys."""
    import msgspec

    from bodyschema.daemon.transport.wire import SCHEMA, encode

    fields = msgspec.json.decode(encode(value), type=dict[str, msgspec.Raw])
    version = msgspec.Raw(str(SCHEMA).encode())
    sys.stdout.write(msgspec.json.encode({"schema": version, **fields}).decode() + "\n")


def several(text: str) -> Parameter:
    """Return an option that may be given more than once; the default is no value."""
    return Parameter(help=f"{text}; more than once for several.", negative="", show_default=False)


def robot_file(given: Path | None, source: Path | None) -> Path:
    """Return `given`, else the robot.toml beside `source`, else that of the environment or the working directory."""
    if given is not None:
        return given
    if source is not None and (sibling := source.parent / HERE).exists():
        return sibling
    return Path(os.environ.get(VARIABLE, HERE))


@Parameter(name="*")
@dataclass(frozen=True)
class PrintedBoard:
    """The board: its nominal page, and the size of the print."""

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
        Literal["charuco", "chessboard"], Parameter(help="`chessboard` has no markers; all of it has to be in view.")
    ] = "charuco"

    ruler_mm: Annotated[
        float | None,
        Parameter(
            help="What the line below the board measures on the print [mm]; else it is what it says.",
            validator=Number(gt=0),
            show_default=False,
        ),
    ] = None

    def nominal_board(self) -> Board:
        """Return the board in its nominal size; raise ConfigError if the options describe no valid one."""
        from bodyschema.cli.cameras.calibration import board_of

        return board_of(
            self.squares, self.square_mm, marker_mm=self.marker_mm, dictionary=self.dictionary, pattern=self.pattern
        )

    def board(self) -> Board:
        """Return the board in its printed size; raise ConfigError if the options describe no valid one."""
        from bodyschema.cli.cameras.calibration import as_printed

        return as_printed(self.nominal_board(), self.ruler_mm)


@Parameter(name="*")
@dataclass(frozen=True)
class EyeFiles:
    """Selection of a folder's images for each eye."""

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
