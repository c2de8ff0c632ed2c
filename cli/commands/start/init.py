"""`bodyschema init`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console
from rich.prompt import Prompt

from bodyschema.cli.commands.options import HERE, flag, say, several
from bodyschema.interfaces.errors import BodyschemaError, ConfigError
from bodyschema.interfaces.whole_files import raising_write_errors, write_atomically

if TYPE_CHECKING:
    from bodyschema.cli.hardware.robot_template import CameraFindings, Guess
    from bodyschema.cli.servos.fitting import Candidate, Fitting

SCAN, ANY = "scan", "any"


def init(
    *,
    robot: Annotated[Path, Parameter(help="The file to write.")] = HERE,
    urdf: Annotated[Path | None, Parameter(help="Your robot's URDF: joints and links are taken from it.")] = None,
    marker_link: Annotated[
        str | None, Parameter(help="The link with the marker; else the last one before the gripper.")
    ] = None,
    camera_link: Annotated[str | None, Parameter(help="The link with the cameras; else the first one.")] = None,
    source: Annotated[
        str | None, Parameter(name="--from", help="`scan` to find the servos, or a file that `scan --json` wrote.")
    ] = None,
    lerobot: Annotated[
        str | None, Parameter(help="An arm of LeRobot: so101, so100, moss, koch or koch_leader; with its URDF.")
    ] = None,
    calibration: Annotated[Path | None, Parameter(help="LeRobot's calibration of this arm, a JSON file.")] = None,
    port: Annotated[tuple[str, ...], several("Scan only this port")] = (),
    baud: Annotated[tuple[int, ...], several("Scan only at this rate")] = (),
    webcam: Annotated[
        str | None,
        Parameter(help="One camera alone: its name in /dev/v4l/by-id, or `any` where only one is plugged in."),
    ] = None,
    tag_mm: Annotated[
        float | None, Parameter(help="The marker is a tag with a side of so many mm.", validator=Number(gt=0, lte=500))
    ] = None,
    ball_mm: Annotated[
        float | None, Parameter(help="The marker is a red ball of this diameter.", validator=Number(gt=0, lte=500))
    ] = None,
    chessboard: Annotated[
        tuple[int, int, float] | None,
        Parameter(
            help="The marker is a plain chessboard: columns and rows of squares, side of a square [mm].", negative=""
        ),
    ] = None,
    yes: Annotated[bool, flag("Do not ask: the joints of the URDF get the servos in the order of their IDs.")] = False,
    sim: Annotated[bool, flag("A whole example: the simulated upper body.")] = False,
) -> None:
    """Write a commented robot.toml. Never replaces a file.

    With --urdf the longest chain of joints is filled in; fingers and joints that mimic others are left out. With
    --from scan each joint gets a servo, chosen by you, and the result is checked against the URDF. With
    --lerobot IDs, directions and zeros come from LeRobot's calibration: one robot.toml for a leader, another one for a
    follower. --webcam, --tag-mm, --ball-mm and --chessboard fill in camera and marker. Without --urdf the names are
    examples. Nothing is written to any servo.

    Needs: your robot's URDF; with --from scan, powered servos; with --lerobot, LeRobot's calibration of the arm; with
    --sim, nothing.

    Next: correct the lines marked CHECK, then `bodyschema config`. With servos: `bodyschema watch joints`. With --sim
    nothing is left to correct: `bodyschema run --sim`.
    """
    _require_one_way(sim=sim, lerobot=lerobot, source=source, urdf=urdf)
    if os.path.lexists(robot):
        raise ConfigError("is there already", file=robot, remedy="Give another --robot, or move it away")
    from bodyschema.cli.hardware.robot_template import EXAMPLE, guess_from, robot_toml

    seen = _seen(webcam, tag_mm, ball_mm, chessboard, plugged_in=bool(lerobot or source))
    with raising_write_errors(robot, remedy="Give another --robot"):
        if sim:
            _copy_model(robot)
        elif lerobot is not None:
            write_new(robot, _of_lerobot(lerobot, urdf, robot, calibration, port, seen))
        elif source is not None and urdf is not None:
            guess = guess_from(urdf, robot, marker_link, camera_link)
            _with_servos(guess, robot, _candidates(source, port, baud), seen, yes=yes)
        else:
            guess = EXAMPLE if urdf is None else guess_from(urdf, robot, marker_link, camera_link)
            write_new(robot, robot_toml(guess, seen))
    following = "run --sim" if sim else "watch joints" if lerobot or source else "config"
    say(f"{robot} written. Next: `bodyschema {following} --robot {robot}`")


def _seen(
    webcam: str | None,
    tag_mm: float | None,
    ball_mm: float | None,
    chessboard: tuple[int, int, float] | None,
    *,
    plugged_in: bool,
) -> CameraFindings:
    """Return the cameras and the marker; the cameras are the connected ones if `plugged_in`."""
    from bodyschema.cli.hardware.robot_template import CameraFindings
    from bodyschema.daemon.wiring.wiring import connected_cameras

    markers = {"--tag-mm": tag_mm, "--ball-mm": ball_mm, "--chessboard": chessboard}
    given = [name for name, value in markers.items() if value is not None]
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} exclude each other", remedy="Give the one that is on the hand")
    cameras = connected_cameras() if plugged_in or webcam == ANY else ()
    if webcam == ANY:
        if len(cameras) != 1:
            what = f"the cameras here are {', '.join(cameras)}" if cameras else "no camera is plugged in"
            raise ConfigError(f"--webcam any: {what}", remedy="Give the name of one, from /dev/v4l/by-id")
        webcam = cameras[0]
    return CameraFindings(cameras, webcam, tag_mm, ball_mm, chessboard)


def _with_servos(
    guess: Guess, robot: Path, candidates: Sequence[Candidate], seen: CameraFindings, *, yes: bool
) -> None:
    """Write robot.toml with a servo for each joint, and remove it again if it does not fit the URDF."""
    from bodyschema.cli.hardware.robot_template import robot_toml
    from bodyschema.cli.servos.fitting import first_of, fit, servo_tables
    from bodyschema.daemon.config import Config

    fitting = fit(guess.joints, candidates, first_of if yes else _asked_servo)
    text = robot_toml(guess._replace(joints=list(fitting.servos)), seen) + servo_tables(fitting)
    write_new(robot, text)
    try:
        Config.load(robot)
    except BodyschemaError:
        robot.unlink()
        raise
    for line in _summary(fitting):
        say(line)


def _of_lerobot(
    name: str, urdf: Path | None, robot: Path, calibration: Path | None, ports: Sequence[str], seen: CameraFindings
) -> str:
    """Return a robot.toml for an arm of LeRobot."""
    from bodyschema.cli.hardware.lerobot_robot import lerobot_arm, lerobot_port, lerobot_robot_toml
    from bodyschema.daemon.wiring import servos as servo_wiring
    from bodyschema.robot.lerobot import where_calibrations_are

    arm = lerobot_arm(name)
    if urdf is None:
        raise ConfigError(
            "--lerobot needs the arm's URDF", remedy="Give it with --urdf; SO-ARM100 has one in Simulation/"
        )
    if calibration is None:
        raise ConfigError(
            "--lerobot needs the arm's calibration", remedy=f"Give --calibration. {where_calibrations_are()}"
        )
    if len(ports) != 1:
        ports = servo_wiring.ports_to_scan(ports, None)
        ports = [lerobot_port(arm, lambda bauds: servo_wiring.scan(ports, bauds, lambda _: None))]
    return lerobot_robot_toml(arm, urdf, robot, calibration, ports[0], seen)


def write_new(file: Path, text: str) -> None:
    """Write a new file; raise ConfigError if it exists."""
    if os.path.lexists(file):
        raise ConfigError("is there already", file=file, remedy="Give another --robot, or move it away")
    with raising_write_errors(file, remedy="Give another --robot"):
        write_atomically({file: text.encode()})


def _copy_model(robot: Path) -> None:
    from bodyschema.daemon.wiring.wiring import demonstration_model

    model = demonstration_model()
    write_new(robot, model.read_text(encoding="utf-8"))
    for urdf in model.parent.glob("*.urdf"):
        write_new(robot.parent / urdf.name, urdf.read_text(encoding="utf-8"))


def _candidates(source: str, ports: Sequence[str], bauds: Sequence[int]) -> list[Candidate]:
    from bodyschema.cli.hardware.scan_report import as_json, report_of
    from bodyschema.cli.servos.fitting import candidates_in, read_scan
    from bodyschema.cli.terminal.screen import shown_on
    from bodyschema.daemon.wiring import servos as servo_wiring

    if source != SCAN:
        return read_scan(Path(source))
    found = servo_wiring.ports_to_scan(ports, None)
    with shown_on(Console(stderr=True, highlight=False), "scan") as tell:
        report = report_of(servo_wiring.scan(found, bauds, tell), None)
    return candidates_in(as_json(report).encode(), SCAN)


def _asked_servo(joint: str, left: Sequence[Candidate]) -> Candidate | None:
    """Ask the user which servo moves `joint`; return it, or None."""
    if not left:
        return None
    names = {_name(servo, left): servo for servo in left}
    listed = ", ".join(f"{name} ({servo.model})" for name, servo in names.items())
    answer = Prompt.ask(
        f"Which ID moves [bold]{joint}[/bold]? {listed}, or - for none",
        choices=[*names, "-"],
        default=next(iter(names)),
        show_choices=False,
    )
    return names.get(answer)


def _name(servo: Candidate, left: Sequence[Candidate]) -> str:
    """Return its ID, with its port if the ID is not unique."""
    alone = sum(other.id == servo.id for other in left) == 1
    return str(servo.id) if alone else f"{servo.id}@{servo.port}"


def _summary(fitting: Fitting) -> list[str]:
    lines = [f"  {joint}: ID {servo.id}, {servo.model}" for joint, servo in fitting.servos.items()]
    lines += [f"  {joint}: no servo, so it is not in joints and stands still at 0" for joint in fitting.bare]
    lines += [f"  ID {servo.id}, {servo.model}: moves none of the joints" for servo in fitting.left]
    return lines


def _require_one_way(*, sim: bool, lerobot: str | None, source: str | None, urdf: Path | None) -> None:
    """Raise ConfigError if several ways to begin are given, or one without its required options."""
    sources = [name for name, given in (("--sim", sim), ("--lerobot", lerobot), ("--from", source)) if given]
    if len(sources) > 1:
        raise ConfigError(f"{' and '.join(sources)} exclude each other", remedy="Give one of them")
    if source is not None and urdf is None:
        raise ConfigError("--from needs the robot's URDF", remedy="Give it with --urdf")
