"""`bodyschema fleet`."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console
from rich.live import Live

from bodyschema.cli.commands.options import ANYTHING, HERE, VARIABLE, SearchOptions, flag, print_json, say, several
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.waits import Waits

if TYPE_CHECKING:
    from bodyschema.cli.recordings.diagnosis import DiagnosisSettings
    from bodyschema.fleet.diagnosing import Job
    from bodyschema.fleet.roster import Place


def fleet(
    *recordings: Annotated[Path, Parameter(help="Recordings (.csv, .parquet) or sample stores (.sqlite) to diagnose.")],
    folder: Annotated[
        Path | None, Parameter(name="--from", help="Diagnose all recordings in this folder and those in it.")
    ] = None,
    connect: Annotated[
        tuple[str, ...], several("A router, or a robot's process, to look for robots at, like tcp/127.0.0.1:7447")
    ] = (),
    robot: Annotated[
        tuple[Path, ...],
        several(
            f"robot.toml that names where to look, and its certificates; else {VARIABLE} or the one here. Of "
            "recordings: the one of all; else the one beside each"
        ),
    ] = (),
    compare: Annotated[bool, flag("Compare the models of running robots of one type.")] = False,
    watch: Annotated[bool, flag("Go on showing the list, until Ctrl-C.")] = False,
    out: Annotated[
        Path | None, Parameter(help="Of recordings: write a folder for each, with report.html and the rest, here.")
    ] = None,
    scheduler: Annotated[
        str | None,
        Parameter(help="Of recordings: a Dask scheduler's address, tcp://HOST:8786; else this machine's cores."),
    ] = None,
    workers: Annotated[
        int | None, Parameter(help="Processes on this machine; else one for each core.", validator=Number(gte=1))
    ] = None,
    search: SearchOptions = ANYTHING,
    as_json: Annotated[bool, flag("Print it as JSON.", name="--json")] = False,
) -> None:
    """List all running robots; compare them; or diagnose many recordings in parallel.

    Without recordings, robots are found by their liveliness tokens: samples, rate, error, answering model, health. With
    --watch --json, prints one line about every second. Exit code 1 if no robot is found.

    --compare finds the unit that differs, and in which figures. Robots are of one type if their joints have the same
    names. Their learners are queried at the same poses, from the ranges that most of them have moved in. Each model is
    rigidly aligned with the median of all, since the cameras stand in different places. Joint offsets and tools that
    differ from the others' are named. Two robots of a type can be compared; three show which one differs.

    With recordings, `bodyschema diagnose` runs on each of them, and the unit of a type that differs is named, with the
    cause. A recording that fails is a row with the reason. An error that more than half of the units of a type share is
    attributed to their description. Ctrl-C ends it and keeps the reports already written. Exit code 1 if no recording
    could be diagnosed.

    Needs: running robots (`bodyschema run`), and a network route to them; or recordings and the extra `fleet`
    (`pip install 'bodyschema[fleet]'`); workers elsewhere need this package, not the files.

    Next: `bodyschema fleet --compare`; `bodyschema status --robot` for one of them; open OUT/NAME/report.html.
    """
    if recordings or folder is not None:
        if connect or compare or watch:
            raise RequestError("recordings do not go with --connect, --compare or --watch")
        if len(robot) > 1:
            raise RequestError("recordings take one --robot, that of all")
        from bodyschema.fleet.diagnosing import jobs
        from bodyschema.interfaces.extras import require_extra

        require_extra("fleet", "diagnosing many recordings")
        pending = jobs(recordings, folder, robot[0] if robot else None)
        _diagnose(pending, search.settings(), out, scheduler, workers, as_json=as_json)
    elif any(given is not None for given in (out, scheduler, search.effects, search.exclude)):
        raise RequestError("--out, --scheduler, --effects and --exclude go with recordings; give some, or --from")
    elif compare:
        _compare(_places(connect, robot), as_json=as_json)
    else:
        _list(_places(connect, robot), watch=watch, json=as_json)


def _list(given_paths: list[Place], *, watch: bool, json: bool) -> None:
    from bodyschema.fleet.roster import Fleet, as_json, screen

    console = Console(highlight=False)
    with Fleet(given_paths) as robots:
        if watch and not json:
            with Live(console=console, auto_refresh=False, screen=console.is_terminal) as live:
                while True:
                    live.update(screen(robots.poll(), robots.unreachable), refresh=True)
                    time.sleep(Waits.status_every_s)
        while True:
            members = robots.poll()
            if json:
                console.file.write(as_json(members) + "\n")
                console.file.flush()
            elif members:
                console.print(screen(members, robots.unreachable))
            if not watch:
                break
            time.sleep(Waits.status_every_s)
    if not any(member.alive for member in members):
        _nobody(given_paths)


def _compare(given_paths: list[Place], *, as_json: bool) -> None:
    from bodyschema.fleet.comparison import compare_types, view
    from bodyschema.fleet.roster import Fleet

    with Fleet(given_paths) as robots:
        members = robots.poll()
        if not any(member.alive for member in members):
            _nobody(given_paths)
        found, left_out = compare_types(robots, members)
    if not found:
        raise RequestError(f"nothing to compare. {'; '.join(left_out)}")
    if as_json:
        print_json({"types": found, "not_compared": left_out})
        return
    Console(highlight=False).print(view(found, left_out))


def _diagnose(
    pending: list[Job],
    settings: DiagnosisSettings,
    out: Path | None,
    scheduler: str | None,
    workers: int | None,
    *,
    as_json: bool,
) -> None:
    from bodyschema.fleet.diagnosing import diagnose_all
    from bodyschema.fleet.diagnosing import workers as cluster
    from bodyschema.fleet.summary import progress, summary, view

    with (
        progress(Console(stderr=True, highlight=False), len(pending)) as (tell, done),
        cluster(scheduler, len(pending), workers) as client,
    ):
        results = diagnose_all(pending, settings, out, client, tell, done)
    found = summary(results)
    if as_json:
        print_json(found)
    else:
        Console(highlight=False).print(view(found))
        if out is not None:
            say(f"\nEach report is {out}/NAME/report.html.")
    if all(row.error is not None for row in found.rows):
        sys.exit(1)


def _places(connect: tuple[str, ...], robot: tuple[Path, ...]) -> list[Place]:
    from bodyschema.fleet.roster import places

    described = robot or (() if connect else (Path(os.environ.get(VARIABLE, HERE)),))
    return places(connect, described)


def _nobody(places: list[Place]) -> None:
    where = ", ".join(str(place.route) for place in places)
    raise BusError(
        f"no robot is alive on {where}. Start one with `bodyschema run`; at a router with TLS, your name needs the "
        "role viewer (docs/security.md)"
    )
