"""`bodyschema marker`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import cyclopts
from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import BY_NAME, HERE, EyeFiles, RobotFile, flag, print_json, say
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import RequestError

if TYPE_CHECKING:
    from bodyschema.cli.cameras.calibration import Images
    from bodyschema.daemon.wiring.markers import TagSelection

marker = cyclopts.App(
    name="marker",
    help="""The marker: a page of tags to print, where they are on what was built, or a ball's colour.

    Needs: a printer for tags; for a ball images in the light and at the exposure of later.

    Next: `bodyschema marker print`, or `bodyschema marker learn`.
    """,
)


Family = Annotated[
    Literal["apriltag_36h11", "aruco_6x6_50", "aruco_6x6_100", "aruco_6x6_250", "aruco_6x6_1000", "aruco_mip_36h12"],
    Parameter(help="Which tags."),
]


@marker.command(name="print", sort_key=1)
def print_tags(
    *,
    shape: Annotated[
        Literal["tags", "plate", "cube", "board", "chessboard"],
        Parameter(
            help="Single tags to cut apart; a plate, flat or folded between its columns; a cube to fold; a ChArUco "
            "board, which calibrates cameras, too; a plain chessboard."
        ),
    ] = "tags",
    ids: Annotated[
        str | None, Parameter(help="Numbers of the tags, as in 0-5,9, row by row; else from 0 on.", show_default=False)
    ] = None,
    family: Family = "apriltag_36h11",
    side_mm: Annotated[
        float | None,
        Parameter(
            help="Side of a tag's black square, or of a chessboard's [mm]. Default 40, of boards 20 and 30.",
            validator=Number(gte=5, lte=500),
            show_default=False,
        ),
    ] = None,
    columns: Annotated[
        int | None,
        Parameter(help="Of a plate (default 2), or a board (8).", validator=Number(gte=1, lte=20), show_default=False),
    ] = None,
    rows: Annotated[
        int | None,
        Parameter(help="Of a plate (default 1), or a board (5).", validator=Number(gte=1, lte=20), show_default=False),
    ] = None,
    fold_deg: Annotated[
        float, Parameter(help="By how much each column of a plate is folded away from the one before [°].")
    ] = 0.0,
    ruler_mm: Annotated[
        float | None,
        Parameter(
            help="What the line below measures on the print [mm]; the tables are then of that size.",
            validator=Number(gt=0),
            show_default=False,
        ),
    ] = None,
    paper: Annotated[str, Parameter(help="A4, A3, A2, A1, A0, letter, legal or tabloid.")] = "A4",
    out: Annotated[Path, Parameter(help="The file to write, .pdf or .svg.")] = Path("tags.pdf"),
) -> None:
    """Write a page with tags in true size, and print their tables for robot.toml.

    Cut along solid lines and fold along dashed ones. Print at 100 % ("actual size") and measure the two rulers. Paper
    alone is not rigid: glue the sheet around a block, or onto a plate, with faces of the stated width. The tables hold
    for the nominal shape; `bodyschema marker learn` measures where the tags really are.

    Needs: a printer.

    Next: put the printed tables into robot.toml; `bodyschema marker learn` for tags glued by hand.
    """
    from bodyschema.cli.cameras.board_pages import write_page
    from bodyschema.cli.cameras.tag_pages import Tags, as_printed, face_mm, sheet, tables

    usual_mm, *usual = {"board": (20.0, 8, 5), "chessboard": (30.0, 8, 5)}.get(shape, (40.0, 2, 1))
    nominal = Tags(shape, ids, family, side_mm or usual_mm, columns or usual[0], rows or usual[1], fold_deg)
    across, upright = write_page(sheet(nominal, paper), out)
    tags = nominal if ruler_mm is None else as_printed(nominal, across, ruler_mm)
    rulers = (
        f"each is {across:g} mm" if across == upright else f"{across:g} mm below the picture, {upright:g} mm beside it"
    )
    message = f"{out} written. Print it at 100 %, then measure both rulers: {rulers}."
    if nominal.body is not None:
        message += f" Each {'square' if shape == 'board' else 'face'} is {face_mm(tags):.1f} mm wide."
    say(message, stderr=True)
    sys.stdout.write(tables(tags))


@marker.command(sort_key=2)
def learn(
    *images: Annotated[
        Path,
        Parameter(
            help="Of a ball: image files of one camera, with --auto in the order of time. Of a cluster: the folder "
            "with left01.png and right01.png, or left/ and right/."
        ),
    ],
    at: Annotated[
        tuple[float, float] | None,
        Parameter(help="Ball: column and row of a pixel in the middle of it, in the first image [px].", negative=""),
    ] = None,
    auto: Annotated[bool, flag("Ball: learn the colour of what moves; the camera stands still.")] = False,
    robot: RobotFile = HERE,
    seconds: Annotated[
        float, Parameter(help="Ball, without IMAGES: how long it is moved [s].", validator=Number(gte=1, lte=120))
    ] = 5.0,
    side_mm: Annotated[
        float | None, Parameter(help="Cluster: side of the black squares as measured [mm].", validator=Number(gt=0))
    ] = None,
    other_sides_mm: Annotated[
        str | None, Parameter(help="Cluster: tags of another side [mm], as in 7=25,8=25.", show_default=False)
    ] = None,
    calibration: Annotated[Path, Parameter(help="Cluster: the calibration of the cameras.")] = Path("cameras.toml"),
    files: EyeFiles = BY_NAME,
    ids: Annotated[
        str | None,
        Parameter(help="Cluster: numbers of its tags, as in 0-5,9; else all that are seen.", show_default=False),
    ] = None,
    family: Family = "apriltag_36h11",
    as_json: Annotated[bool, flag("Cluster: print the figures as JSON.", name="--json")] = False,
) -> None:
    """Learn a ball's colour or a cluster's shape from images, and print the table for robot.toml.

    Ball: with --at, it is the connected region with the colour of that pixel. With --auto, give three images or more in
    which the ball moves; the most colourful moving object is taken. With --auto and no images, the robot's own cameras
    watch while you move the ball.

    Cluster (--side-mm): the poses of its tags. Take about 20 pairs of images and turn the cluster from one to the next,
    so that every two neighbouring tags are visible together at some time. The tags' poses and all cluster poses are
    fitted together; the marker's frame is that of the tag with the lowest number. Observations that do not fit one
    rigid body are left out and named.

    Needs: images, and for a cluster cameras.toml of those cameras; or robot.toml with cameras, and no running sampler.

    Next: put the printed tables into robot.toml, a colour in place of `colour = ...`; `bodyschema watch cameras`.
    """
    from bodyschema.daemon.wiring.markers import learnt_colour_table

    if side_mm is not None:
        if auto or at is not None or len(images) != 1:
            raise RequestError("--side-mm measures a cluster: give one folder of images, and neither --at nor --auto")
        from bodyschema.cli.cameras.tag_pages import numbers_of
        from bodyschema.daemon.wiring.markers import TagSelection, sides_of

        numbers = None if ids is None else tuple(numbers_of(ids))
        selection = TagSelection(family, 1e-3 * side_mm, numbers, sides_of(other_sides_mm) if other_sides_mm else {})
        _measure_cluster(files.of(images[0]), calibration, selection, as_json=as_json)
        return
    if auto == (at is not None) or (not images and not auto):
        raise RequestError(
            "give image files and --at COLUMN ROW, or --auto; the robot's own cameras need --auto; a cluster of tags "
            "needs --side-mm"
        )
    sys.stdout.write(learnt_colour_table(images, at) if images else _learnt_live(robot, seconds))


def _measure_cluster(images: Images, calibration: Path, selection: TagSelection, *, as_json: bool) -> None:
    from bodyschema.daemon.wiring.markers import figures, measured, said, tables

    found = measured(images, calibration, selection, partial(say, stderr=True))
    if as_json:
        print_json(figures(found))
        return
    say(said(found), stderr=True)
    sys.stdout.write(tables(found, selection))


def _learnt_live(robot: Path, seconds: float) -> str:
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.cameras import open_eyes
    from bodyschema.daemon.wiring.markers import moving_colour_table

    clock = SystemClock()
    eyes = open_eyes(Config.load(robot), clock)
    return moving_colour_table(eyes, clock, seconds, partial(say, stderr=True))
