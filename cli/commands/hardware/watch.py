"""`bodyschema watch`."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console
from rich.live import Live

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say
from bodyschema.daemon.service.signals import SignalFlags, on_termination
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.waits import Waits

if TYPE_CHECKING:
    from collections.abc import Callable

    from bodyschema.cli.hardware.joints_watch import ArmState, JointsWatch
    from bodyschema.daemon.sampler.sources import PoweredMode


class _Settings:
    read_s: float = 0.5  # one look at all sources
    print_every_s: float = 0.5  # interval of the lines or the screen
    first_reading_s: float = 5.0  # how long the first reading is waited for


def watch(
    what: Annotated[Literal["joints", "cameras", "marker"], Parameter(help="Which part of the hardware.")],
    /,
    *,
    robot: RobotFile = HERE,
    once: Annotated[bool, flag("Joints: one table, then end.")] = False,
    json: Annotated[bool, flag("Joints: a line of JSON instead, every half second.")] = False,
    zero_force: Annotated[
        bool, flag("Joints: the servos bear the arm meanwhile: [drivers.dynamixel.zero_force].")
    ] = False,
    out: Annotated[
        Path | None, Parameter(help="Cameras: write the pictures into this folder, instead of showing them.")
    ] = None,
    port: Annotated[
        int,
        Parameter(help="Cameras: for the browser on this machine; 0: a free one.", validator=Number(gte=0, lte=65535)),
    ] = 8080,
    every: Annotated[
        float, Parameter(help="Cameras, with --out: time between two pictures [s].", validator=Number(gte=0))
    ] = 0.5,
    count: Annotated[
        int | None,
        Parameter(help="Cameras: end after this number of pictures; else with Ctrl-C.", validator=Number(gte=1)),
    ] = None,
    seconds: Annotated[
        float | None, Parameter(help="Marker: end after this time [s]; else with Ctrl-C.", validator=Number(gt=0))
    ] = None,
) -> None:
    """Show what joints, cameras or other marker sources deliver, until Ctrl-C.

    `joints`: angle, speed, current and temperature of each joint while you move it by hand. Servo torque is switched
    off first: hold the arm, because it will sink. With --zero-force the servos then hold it, until Ctrl-C or any fault:
    stay ready to hold it. The line below the table shows the marker's motion that the URDF predicts for the last moved
    joint: if it really went the other way, the sign is wrong. Angles beyond the URDF's limits are reported, too.

    `cameras`: the images with their detections, in a browser on this machine or as files. Yellow: a disc of the
    marker's colour. Green: the marker, with the corresponding row of the other image in yellow, and the row difference
    as a red bar, ten times as long. Red: rejected detections, with the reason. Tags have their numbers; the marker made
    of them has its axes x, y, z in red, green, blue. Without a calibration, the raw images are shown.

    `marker`: the data of other marker sources: rate, position, uncertainty, delay, and faults of their messages.

    Needs: robot.toml with servos, encoders or a ROS 2 robot; with cameras (docs/cameras.md); or with [marker_source]
    (docs/marker_sources.md). No running sampler, because ports and cameras can be opened only once.

    Next: correct the reported faults; `bodyschema calibrate cameras`, `bodyschema calibrate latency`; `bodyschema run`.
    """
    if what == "joints":
        _joints(robot, once=once, json=json, zero_force=zero_force)
    elif what == "cameras":
        _cameras(robot, out, port, every, count)
    else:
        _marker(robot, seconds)


def _joints(robot: Path, *, once: bool, json: bool, zero_force: bool) -> None:
    from bodyschema.cli.hardware.joints_watch import JointsWatch, as_json, screen
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.sampler.sources import find_powered
    from bodyschema.daemon.wiring.wiring import open_joints
    from bodyschema.interfaces.servos import ServoJoints

    clock = SystemClock()
    config = Config.load(robot)
    console = Console(highlight=False)
    flags = SignalFlags()
    source = open_joints(config, clock)
    drives = source.drives if isinstance(source, ServoJoints) else ()
    force = find_powered(drives, "zero_force", config.file) if zero_force else None
    with on_termination(flags.end), JointsWatch(config, source, clock) as watch:
        seen = _first(watch)
        if force is not None:
            _begin(watch, force)
        if once:
            console.file.write(as_json(seen) + "\n") if json else console.print(screen(seen))
        elif json or not console.is_terminal:
            _follow(
                watch,
                flags,
                _Settings.print_every_s,
                lambda now: _line(as_json(now)) if json else console.print(screen(now)),
            )
        else:
            with Live(screen(seen), console=console, auto_refresh=False, screen=True) as live:
                _follow(watch, flags, Waits.poll_s, lambda now: live.update(screen(now), refresh=True))


def _cameras(robot: Path, out: Path | None, port: int, every: float, count: int | None) -> None:
    from bodyschema.cli.cameras.watching import MjpegServer, Watching
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.wiring.cameras import open_watched

    watched = open_watched(Config.load(robot))
    with ExitStack() as stack:
        if out is None:
            server = stack.enter_context(MjpegServer(port))
            watching = Watching(watched.camera, server.show, count=count)
            say(f"look at {server.address}")
        else:
            watching = Watching.into(out, watched.camera, every_s=every, count=count)
        if not watched.is_calibrated:
            say("nothing says how the cameras see: the images as they come. `bodyschema calibrate cameras`")
        stack.enter_context(watched.camera)
        stack.enter_context(on_termination(watching.stop))
        tell_at = time.monotonic() + Waits.line_every_s
        while watching.step(_Settings.read_s):
            if time.monotonic() >= tell_at:
                tell_at = time.monotonic() + Waits.line_every_s
                say(watched.camera.said, *watched.eyes.health)
    say(watched.camera.said, *watched.eyes.health)


def _marker(robot: Path, seconds: float | None) -> None:
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.marker_watch import MarkerWatch
    from bodyschema.daemon.wiring.wiring import open_streams

    clock = SystemClock()
    with ExitStack() as stack:
        watches = [
            MarkerWatch(stream.name, stream, stream, clock) for stream in open_streams(Config.load(robot), clock)
        ]
        for each in watches:
            stack.enter_context(each)
        flags = SignalFlags()
        stack.enter_context(on_termination(flags.end))
        end = clock.now() + (float("inf") if seconds is None else seconds)
        while not flags.ending and clock.now() < end:
            tell_at = min(clock.now() + Waits.status_every_s, end)
            while clock.now() < tell_at and not flags.ending:
                for each in watches:
                    each.read(_Settings.read_s / 10)
            for each in watches:
                say(*each.lines())


def _line(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _first(watch: JointsWatch) -> ArmState:
    """Return the first complete state; raise SourceError if it does not come in time."""
    end = time.monotonic() + _Settings.first_reading_s
    while time.monotonic() < end:
        if watch.look() is not None:
            watch.read_temperatures()
            seen = watch.look_at_all_servos()
            if seen is not None:
                return seen
    raise SourceError("the joints cannot be read. `bodyschema doctor` shows why")


def _begin(watch: JointsWatch, force: PoweredMode) -> None:
    """Switch zero-force on and print its answer; raise RequestError if it is refused."""
    answer = force.ask(True)
    while not answer.done():
        watch.look()
    sys.stderr.write(answer.result() + "\n")


def _follow(watch: JointsWatch, flags: SignalFlags, every_s: float, show: Callable[[ArmState], None]) -> None:
    shown_at = 0.0
    while not flags.ending:
        seen = watch.look()
        if seen is not None and time.monotonic() - shown_at >= every_s:
            shown_at = time.monotonic()
            show(seen)
