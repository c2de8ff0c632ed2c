"""`bodyschema fleet`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cyclopts
from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, VARIABLE, flag, several

if TYPE_CHECKING:
    from bodyschema.fleet.roster import Place

fleet = cyclopts.App(
    name="fleet",
    help="""Many robots: who is there, which unit is off, and why.

    Needs: robots whose processes run, at a router or on this machine; for `diagnose` only their recordings.

    Next: `bodyschema fleet list`, `bodyschema fleet compare`, `bodyschema fleet diagnose RECORDING...`.
    """,
)

Connect = Annotated[
    tuple[str, ...], several("A router, or a robot's process, to look for robots at, like tcp/127.0.0.1:7447")
]
Robots = Annotated[
    tuple[Path, ...],
    several(f"robot.toml that names where to look, and its certificates; else {VARIABLE} or the one here"),
]


@fleet.command(name="list", sort_key=1)
def list_robots(
    *,
    connect: Connect = (),
    robot: Robots = (),
    watch: Annotated[bool, flag("Go on showing it, until Ctrl-C.")] = False,
    json: Annotated[bool, flag("As JSON, a list with both processes' states.")] = False,
) -> None:
    """List all running robots: pairs, rate, error, answering model, health.

    Robots are found by their liveliness tokens. With --watch --json, prints one line about every second. Exit code 1 if
    no robot is found.

    Needs: running robots (`bodyschema run`), and a network route to them.

    Next: `bodyschema fleet compare`; `bodyschema status --robot` for one of them.
    """
    import time

    from rich.console import Console
    from rich.live import Live

    from bodyschema.cli.terminal.status_view import EVERY_S
    from bodyschema.fleet.roster import Fleet
    from bodyschema.fleet.roster_view import as_json, screen

    looked_at, console = _places(connect, robot), Console(highlight=False)
    with Fleet(looked_at) as robots:
        if watch and not json:
            with Live(console=console, auto_refresh=False, screen=console.is_terminal) as live:
                while True:
                    live.update(screen(robots.look(), robots.unreached), refresh=True)
                    time.sleep(EVERY_S)
        while True:
            members = robots.look()
            if json:
                console.file.write(as_json(members) + "\n")
                console.file.flush()
            elif members:
                console.print(screen(members, robots.unreached))
            if not watch:
                break
            time.sleep(EVERY_S)
    if not any(member.alive for member in members):
        _nobody(looked_at)


@fleet.command(sort_key=2)
def compare(
    *,
    connect: Connect = (),
    robot: Robots = (),
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Compare the models of robots of one type; find the unit that differs, and in which figures.

    Robots are of one type if their joints have the same names. Their learners are queried at the same poses, from the
    ranges that most of them have moved in. Each model is rigidly aligned with the median of all, since the cameras
    stand in different places. Joint offsets and tools that differ from the others' are named.

    Needs: at least two robots of a type with running learners, and the sampler of one of them; three to find which
    differs.

    Next: `bodyschema fleet diagnose` with their recordings, for causes.
    """
    from rich.console import Console

    from bodyschema.daemon.transport.wire import encode
    from bodyschema.fleet.asking import compare_types
    from bodyschema.fleet.comparison_view import view
    from bodyschema.fleet.roster import Fleet
    from bodyschema.interfaces.errors import RequestError

    looked_at = _places(connect, robot)
    with Fleet(looked_at) as robots:
        members = robots.look()
        if not any(member.alive for member in members):
            _nobody(looked_at)
        found, left_out = compare_types(robots, members)
    if not found:
        raise RequestError(f"nothing to compare. {'; '.join(left_out)}")
    if as_json:
        sys.stdout.write(encode({"types": found, "not_compared": left_out}).decode() + "\n")
        return
    Console(highlight=False).print(view(found, left_out))


@fleet.command(sort_key=3)
def diagnose(
    *recordings: Annotated[Path, Parameter(help="Recordings (.csv, .parquet) or pair stores (.sqlite).")],
    folder: Annotated[
        Path | None, Parameter(name="--from", help="All recordings in this folder and those in it.")
    ] = None,
    robot: Annotated[
        Path | None,
        Parameter(show_default=False, help=f"robot.toml of all; else the one beside each, {VARIABLE}, or here."),
    ] = None,
    out: Annotated[Path | None, Parameter(help="Write a folder for each, with report.html and the rest, here.")] = None,
    scheduler: Annotated[
        str | None, Parameter(help="A Dask scheduler's address, tcp://HOST:8786; else this machine's cores.")
    ] = None,
    workers: Annotated[
        int | None, Parameter(help="Processes on this machine; else one for each core.", validator=Number(gte=1))
    ] = None,
    effects: Annotated[str | None, Parameter(help="Look for these alone, as in backlash,joint_offset.")] = None,
    exclude: Annotated[str | None, Parameter(help="Do not look for these.")] = None,
    seed: Annotated[int, Parameter(help="Of the resampling behind the intervals.", validator=Number(gte=0))] = 0,
    as_json: Annotated[bool, flag("Print the summary as JSON.", name="--json")] = False,
) -> None:
    """Run `bodyschema diagnose` on many recordings in parallel; find the unit of a type that differs, and why.

    A recording that fails is a row with the reason. An error that more than half of the units of a type share is
    attributed to their description. Ctrl-C ends it and keeps the reports already written. Exit code 1 if no recording
    could be diagnosed.

    Needs: the extra `fleet` (`pip install 'bodyschema[fleet]'`); workers elsewhere need this package, not the files.

    Next: open OUT/NAME/report.html.
    """
    from rich.console import Console

    from bodyschema.cli.terminal.diagnosis_run import Asked
    from bodyschema.daemon.transport.wire import encode
    from bodyschema.fleet.diagnosing import diagnose_all
    from bodyschema.fleet.diagnosing import workers as cluster
    from bodyschema.fleet.recordings import jobs
    from bodyschema.fleet.summary import summary
    from bodyschema.fleet.summary_view import progress, view
    from bodyschema.interfaces.extras import require_extra

    require_extra("fleet", "diagnosing many recordings")
    wanted, asked = jobs(recordings, folder, robot), Asked.of(effects, exclude, seed)
    with (
        progress(Console(stderr=True, highlight=False), len(wanted)) as (told, done),
        cluster(scheduler, len(wanted), workers) as client,
    ):
        results = diagnose_all(wanted, asked, out, client, told, done)
    found = summary(results)
    if as_json:
        sys.stdout.write(encode(found).decode() + "\n")
    else:
        console = Console(highlight=False)
        console.print(view(found))
        if out is not None:
            console.print(f"\nEach report is {out}/NAME/report.html.", markup=False)
    if all(row.error is not None for row in found.rows):
        sys.exit(1)


def _places(connect: tuple[str, ...], robot: tuple[Path, ...]) -> list[Place]:
    import os

    from bodyschema.fleet.roster import places

    described = robot or (() if connect else (Path(os.environ.get(VARIABLE, HERE)),))
    return places(connect, described)


def _nobody(places: list[Place]) -> None:
    from bodyschema.interfaces.errors import BusError

    where = ", ".join(str(place.route) for place in places)
    raise BusError(
        f"no robot is alive on {where}. Start one with `bodyschema run`; at a router with TLS, your name needs the "
        "role viewer (docs/security.md)"
    )
