"""`bodyschema diagnose`: its options; `cli/recordings/diagnosis.py` does the work."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console

from bodyschema.cli.commands.options import (
    ANYTHING,
    AS_THEY_ARE,
    WITHOUT_LEROBOT,
    LeRobotOptions,
    SearchOptions,
    SourceOptions,
    SourceRobotFile,
    flag,
    robot_file,
    say,
)
from bodyschema.interfaces.errors import RequestError

if TYPE_CHECKING:
    from bodyschema.cli.recordings.diagnosis import ReportedDiagnosis


def diagnose(
    recording: Annotated[
        Path | None,
        Parameter(
            help="A recording (.csv, .parquet), a ROS bag, a LeRobotDataset or a sample store (.sqlite); or --live."
        ),
    ] = None,
    /,
    *,
    live: Annotated[bool, flag("Take the running sampler's samples, in the place of a recording.")] = False,
    robot: SourceRobotFile = None,
    out: Annotated[
        Path | None,
        Parameter(help="Write diagnosis.json, report.html, extended.toml and perhaps a corrected URDF here."),
    ] = None,
    search: SearchOptions = ANYTHING,
    taken: SourceOptions = AS_THEY_ARE,
    servos: LeRobotOptions = WITHOUT_LEROBOT,
    as_json: Annotated[bool, flag("Print diagnosis.json.", name="--json")] = False,
    force: Annotated[bool, flag("Go on although the samples do not seem to be of this robot.")] = False,
) -> None:
    """Find what the simulation gets wrong in a recording, why, and how much correcting it helps.

    Every known effect is tried at every joint, alone and together, and evaluated on held-out blocks of rows. The result
    is one of these: causes with their numbers and probabilities; nothing is wrong; this recording cannot decide; or no
    known effect explains the error. The exit code is 0 for all of them.

    Without --out nothing is written. Samples are refused if their columns are exchanged, reversed, or have another zero
    or unit, or if they are of another robot.

    Needs: a recording or a store and its robot.toml, no hardware; with --live a running sampler.

    Next: open OUT/report.html; give OUT/extended.toml to any command as --robot, and
    `bodyschema export` turns it into models for MuJoCo, controllers and drivers.
    """
    from bodyschema.cli.recordings.diagnosis import measured, results_in, run, written
    from bodyschema.cli.recordings.foreign import opened
    from bodyschema.daemon.config import Config

    if servos.write and servos.lerobot is None:
        raise RequestError("--write is for --lerobot FILE. Give LeRobot's calibration file")
    config = Config.load(robot_file(robot, recording))
    servos.require(config)
    settings = search.settings()
    source = measured(config, recording, lambda file: opened(config, file, taken, servos.lerobot), live=live)
    with results_in(out), _progress(Console(stderr=True, highlight=False)) as tell:
        found = run(config, source, settings, tell, force=force)
        if out is not None:
            tell("writing the report")
            written(found, out)
    say(*(f"Warning: {warning}" for warning in found.warnings), stderr=True)
    offsets = {
        cause.where: cause.parameters["offset_rad"].value
        for cause in found.file.causes
        if cause.effect == "joint_offset" and cause.where is not None and "offset_rad" in cause.parameters
    }
    lines = servos.lines(config, offsets, recording)
    if as_json:
        sys.stdout.write(found.json + "\n")
        sys.stderr.writelines(f"{line}\n" for line in lines)
        return
    _show(found, lines, out)


def _show(found: ReportedDiagnosis, lines: list[str], out: Path | None) -> None:
    from bodyschema.cli.terminal.diagnosis_view import view

    Console(highlight=False).print(view(found.file, found.remedies, timed=found.timed))
    say(*(["", *lines] if lines else []))
    if out is not None:
        say(
            f"\nOpen {out / 'report.html'}. Beside it are diagnosis.json and extended.toml, the simulation with what "
            f"was found: give it to any command as --robot {out / 'extended.toml'}; robot.toml is unchanged."
        )


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows progress: one changing line on a terminal, elsewhere a line for each step."""
    if console.is_terminal:
        with console.status("reading") as status:
            yield status.update
        return
    yield lambda text: console.print(text, soft_wrap=True, markup=False)
