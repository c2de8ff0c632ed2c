"""`bodyschema watch`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import cyclopts
from cyclopts import Parameter
from cyclopts.validators import Number

from bodyschema.cli.commands.options import HERE, RobotFile

watch = cyclopts.App(
    name="watch",
    help="""What the cameras see and the tracker makes of it, and what other marker sources send.

    Needs: robot.toml with cameras (docs/cameras.md) or [marker_source] (docs/marker_sources.md).

    Next: `bodyschema watch cameras` or `bodyschema watch marker`.
    """,
)

READ_S = 0.5
TELL_EVERY_S = 2.0
MARKER_EVERY_S = 1.0
PORT = 8080


@watch.command(sort_key=1)
def cameras(
    *,
    robot: RobotFile = HERE,
    out: Annotated[
        Path | None, Parameter(help="Write the pictures into this folder, in the place of a browser.")
    ] = None,
    port: Annotated[
        int,
        Parameter(help="For the browser on this machine; 0: a free one.", validator=Number(gte=0, lte=65535)),
    ] = PORT,
    every: Annotated[
        float, Parameter(help="With --out: time between two pictures [s].", validator=Number(gte=0))
    ] = 0.5,
    count: Annotated[
        int | None, Parameter(help="End after so many pictures; else with Ctrl-C.", validator=Number(gte=1))
    ] = None,
) -> None:
    """Show both cameras' images with what was detected in them: in a browser on this machine, or as files.

    Yellow: a disc of the marker's colour. Green: the marker, with the corresponding row of the other image in yellow,
    and the row difference as a red bar, ten times as long. Red: rejected detections, with the reason. Tags have their
    numbers; the marker made of them has its axes x, y, z in red, green, blue. Without a calibration, the raw images are
    shown.

    Needs: robot.toml with cameras, and no running sampler, because a camera can be opened only once.

    Next: correct colour, light or focus; `bodyschema calibrate cameras`; `bodyschema run`.
    """
    from contextlib import ExitStack

    from rich.console import Console

    from bodyschema.cli.cameras.mjpeg import MjpegServer
    from bodyschema.cli.cameras.watching import Watching
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.service.signals import on_termination
    from bodyschema.daemon.wiring.cameras import open_watched

    console = Console(highlight=False, soft_wrap=True)
    watched = open_watched(Config.load(robot))
    with ExitStack() as stack:
        if out is None:
            server = stack.enter_context(MjpegServer(port))
            watching = Watching(watched.camera, server.show, count=count)
            console.print(f"look at {server.address}")
        else:
            watching = Watching.into(out, watched.camera, every_s=every, count=count)
        if not watched.is_calibrated:
            console.print("nothing says how the cameras see: the images as they come. `bodyschema calibrate cameras`")
        stack.enter_context(watched.camera)
        stack.enter_context(on_termination(watching.stop))
        tell_at = time.monotonic() + TELL_EVERY_S
        while watching.step(READ_S):
            if time.monotonic() >= tell_at:
                tell_at = time.monotonic() + TELL_EVERY_S
                for line in (watching.said, *watched.eyes.health):
                    console.print(line, markup=False)
    for line in (watching.said, *watched.eyes.health):
        console.print(line, markup=False)


@watch.command(sort_key=2)
def marker(
    *,
    robot: RobotFile = HERE,
    seconds: Annotated[
        float | None, Parameter(help="End after this time [s]; else with Ctrl-C.", validator=Number(gt=0))
    ] = None,
) -> None:
    """Show what the marker sources send: rate, position, uncertainty, delay, and what is wrong with their messages.

    Needs: robot.toml with [marker_source] (docs/marker_sources.md), and no running sampler, because a UDP port can be
    listened on only once.

    Next: `bodyschema calibrate latency`; `bodyschema run`.
    """
    from contextlib import ExitStack

    from rich.console import Console

    from bodyschema.daemon.config import Config
    from bodyschema.daemon.marker_watch import MarkerWatch
    from bodyschema.daemon.service.signals import on_termination
    from bodyschema.daemon.wiring.wiring import open_streams
    from bodyschema.interfaces.clock import SystemClock

    console = Console(highlight=False, soft_wrap=True)
    clock = SystemClock()
    with ExitStack() as stack:
        watches = [
            MarkerWatch(stream.name, stream, stream, clock) for stream in open_streams(Config.load(robot), clock)
        ]
        for each in watches:
            stack.enter_context(each)
        stopping: list[bool] = []
        stack.enter_context(on_termination(lambda: stopping.append(True)))
        end = clock.now() + (float("inf") if seconds is None else seconds)
        while not stopping and clock.now() < end:
            tell_at = min(clock.now() + MARKER_EVERY_S, end)
            while clock.now() < tell_at and not stopping:
                for each in watches:
                    each.read(READ_S / 10)
            for each in watches:
                for line in each.lines():
                    console.print(line, markup=False)
