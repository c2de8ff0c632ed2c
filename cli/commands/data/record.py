"""`bodyschema record`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, RobotFile, flag, print_json, say
from bodyschema.daemon.service.signals import SignalFlags, on_termination


def record(
    out: Annotated[Path, Parameter(help="The file; its ending .csv, .parquet, .mcap or .rrd says the format.")],
    /,
    *,
    robot: RobotFile = HERE,
    from_seq: Annotated[
        int, Parameter(name="--from", help="Sequence number of the first sample.", validator=Number(gte=1))
    ] = 1,
    follow: Annotated[bool, flag("Go on with the samples to come, until Ctrl-C.")] = False,
    force: Annotated[bool, flag("Replace OUT when it is there.")] = False,
    as_json: Annotated[bool, flag("Print the result as JSON.", name="--json")] = False,
) -> None:
    """Copy the running sampler's samples into a file.

    For the store of a sampler that is not running, use `bodyschema export`.

    Needs: a running sampler (`bodyschema run` or `bodyschema run sampler`).

    Next: `bodyschema replay` on a CSV or Parquet file.
    """
    from bodyschema.cli.recordings.recorder import History, copy_history, follow_history
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.transport.session import client
    from bodyschema.recordings import files as recordings

    recordings.check_target(out, force=force)
    config = Config.load(robot)
    with client(config.route("sampler")) as bus:
        history = History(bus, config.robot, from_seq)
        if follow:
            signals = SignalFlags()
            with on_termination(signals.end):
                if not as_json:
                    say(f"writing samples to {out} as they come; Ctrl-C ends it")
                count = follow_history(history, config.robot, out, lambda: signals.ending)
        else:
            count = copy_history(history, config.robot, out)
    if as_json:
        print_json(
            {"file": str(out), "pairs": count, "last_seq": history.next_seq - 1, "missing": history.missing.count}
        )
        return
    last = f", the last has the number {history.next_seq - 1}" if count else "; no file was left"
    say(f"{count} samples written to {out}{last}")
    if history.missing.count:
        one = history.missing.count == 1
        say(
            f"{history.missing.count} sample{'' if one else 's'} between them {'is' if one else 'are'} missing "
            f"(number{'' if one else 's'} {history.missing}): the sampler's disk changed them, or they were deleted "
            "([daemon] keep_days, keep_mb); `bodyschema status` shows which"
        )
