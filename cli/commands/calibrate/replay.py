"""`bodyschema replay`."""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.options import (
    AS_THEY_ARE,
    DatasetCalibration,
    SourceOptions,
    SourceRobotFile,
    flag,
    robot_file,
)
from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.waits import Waits

if TYPE_CHECKING:
    from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus


def replay(
    recording: Annotated[Path, Parameter(help="A recording (.csv, .parquet), a ROS bag or a LeRobotDataset.")],
    /,
    *,
    robot: SourceRobotFile = None,
    speed: Annotated[
        float | None,
        Parameter(
            help="1 as recorded, 0 as fast as samples are stored; else 30 rows/s or 20 s.", validator=Number(gte=0)
        ),
    ] = None,
    sigma_mm: Annotated[
        float | None,
        Parameter(help="1-sigma of the positions where the recording has none [mm].", validator=Number(gt=0, lte=1000)),
    ] = None,
    any_step: Annotated[bool, flag("Accept rows whatever their step and speed: single poses far apart.")] = False,
    held_out: Annotated[float, Parameter(help="Share of the rows to hold out for the error.")] = 0.3,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
    taken: SourceOptions = AS_THEY_ARE,
    lerobot: DatasetCalibration = None,
    keep: Annotated[Path | None, Parameter(help="Keep store, checkpoint and logs in this new folder.")] = None,
    force: Annotated[bool, flag("Go on although the rows do not seem to be of this robot.")] = False,
) -> None:
    """Feed a recording through sampler and learner; prints the error before and after on rows left out.

    The two processes run as in live use, on their own ports and with their own store, so a running daemon is not
    disturbed. Contiguous blocks of rows are held out. "Before" is the nominal model, with the unknowns of robot.toml
    fitted to the other rows; "after" is the learner's answer when it has learnt them. Rows are refused if their columns
    are exchanged, reversed, or have another zero or unit, or if they are of another robot.

    Needs: a recording and its robot.toml; neither hardware nor a running daemon.

    Next: `bodyschema run` with the arm.
    """
    from bodyschema.calibration.evaluate import split_blocks
    from bodyschema.calibration.plausibility.check import plausibility, recorded_sigma
    from bodyschema.calibration.plausibility.limits import require_units
    from bodyschema.cli.recordings.foreign import opened
    from bodyschema.cli.replay.report import as_text
    from bodyschema.cli.replay.run import Job, Steps, require_path
    from bodyschema.cli.replay.run import replay as run_replay
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.transport.wire import encode
    from bodyschema.learning.nominal import NominalModel

    config = Config.load(robot_file(robot, recording))
    config.require_learnable()
    rows = opened(config, recording, taken, lerobot)
    require_units(config.robot, rows, recording)
    split = split_blocks(len(rows), held_out)
    any_step |= config.tables.daemon.any_step
    if not any_step:
        require_path(Steps.of(rows, config.robot, config.tables.daemon), rows)
    sigma_m = None if sigma_mm is None else 1e-3 * sigma_mm
    chain = NominalModel.extended_by(config.simulation).chain
    seen = plausibility(
        config.robot,
        rows.q,
        rows.x,
        t=rows.t,
        chain=chain,
        sigma_m=recorded_sigma(rows) or sigma_m,
        orientation=rows.orientation,
    )
    warnings = seen.require(recording, force=force)
    if keep is not None:
        _make_folder(keep)
    with _ending_on_sigterm(), tempfile.TemporaryDirectory(prefix="bodyschema-replay-") as temporary:
        job = Job(config, rows, split, speed, sigma_m, any_step, keep or Path(temporary), warnings)
        with _progress(Console(stderr=True, highlight=False)) as show:
            report = run_replay(job, show)
    sys.stdout.write((encode(report).decode() if as_json else as_text(report, Console().width)) + "\n")


@contextmanager
def _ending_on_sigterm() -> Iterator[None]:
    """Unwind the stack on SIGTERM, so that the two processes are ended too."""
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise RecordingError("is there already", file=folder, remedy="Give --keep a new folder") from error
    except OSError as error:
        raise RecordingError(f"cannot be made: {error.strerror}", file=folder) from error


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[SamplerStatus, LearnerStatus], None]]:
    """Yield a function that shows progress: one changing line on a terminal, elsewhere a line every two seconds."""
    if console.is_terminal:
        with console.status("starting sampler and learner") as status:
            yield lambda sampler, learner: status.update(_line(sampler, learner))
        return
    last = -Waits.line_every_s

    def show(sampler: SamplerStatus, learner: LearnerStatus) -> None:
        nonlocal last
        if time.monotonic() - last >= Waits.line_every_s:
            last = time.monotonic()
            console.print(_line(sampler, learner), soft_wrap=True)

    yield show


def _line(sampler: SamplerStatus, learner: LearnerStatus) -> str:
    from bodyschema.cli.terminal.screen import mm

    error = learner.prequential_m.get(learner.answering)
    return (
        f"{sampler.frames} rows fed, {sampler.pairs} samples accepted, {learner.pairs} learnt, "
        f"{learner.replayed} replayed, {learner.state} ({learner.answering}), "
        f"error on new samples {mm(error)}"
    )
