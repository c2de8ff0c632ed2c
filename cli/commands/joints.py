"""`bodyschema joints`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

from bodyschema.cli.commands.options import HERE, RobotFile, flag

if TYPE_CHECKING:
    from collections.abc import Callable

    from bodyschema.cli.hardware.joints_watch import JointsWatch, Seen
    from bodyschema.daemon.sampler.sources import Powered

SHOW_EVERY_S = 0.1
PRINT_EVERY_S = 0.5
FIRST_READING_S = 5.0


def joints(
    *,
    robot: RobotFile = HERE,
    once: Annotated[bool, flag("One table, then end.")] = False,
    json: Annotated[bool, flag("A line of JSON instead, every half second.")] = False,
    zero_force: Annotated[bool, flag("The servos bear the arm meanwhile: [drivers.dynamixel.zero_force].")] = False,
) -> None:
    """Show each joint's angle, speed, current and temperature while you move it by hand. Ends with Ctrl-C.

    Servo torque is switched off first: hold the arm, because it will sink. With --zero-force the servos then hold it,
    until Ctrl-C or any fault: stay ready to hold it. The line below the table shows where, by the URDF, the marker went
    when you moved the last joint: if it went the other way, the sign is wrong. Angles beyond the URDF's limits are
    reported, too.

    Needs: robot.toml with servos (`bodyschema init --from scan`), encoders or a ROS 2 robot, and no running sampler.

    Next: correct what the line below the table names; then `bodyschema run`.
    """
    from rich.console import Console
    from rich.live import Live

    from bodyschema.cli.hardware.joints_view import as_json, screen
    from bodyschema.cli.hardware.joints_watch import JointsWatch
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.sampler.powered import find_powered
    from bodyschema.daemon.service.signals import on_termination
    from bodyschema.daemon.wiring.wiring import open_joints
    from bodyschema.interfaces.clock import SystemClock
    from bodyschema.interfaces.servos import ServoJoints

    clock = SystemClock()
    config = Config.load(robot)
    console = Console(highlight=False)
    ending = _Ending()
    source = open_joints(config, clock)
    drives = source.drives if isinstance(source, ServoJoints) else ()
    force = find_powered(drives, "zero_force", config.file) if zero_force else None
    with on_termination(ending.end), JointsWatch(config, source, clock) as watch:
        seen = _first(watch)
        if force is not None:
            _begin(watch, force)
        if once:
            console.file.write(as_json(seen) + "\n") if json else console.print(screen(seen))
        elif json or not console.is_terminal:
            _follow(
                watch, ending, PRINT_EVERY_S, lambda now: _line(as_json(now)) if json else console.print(screen(now))
            )
        else:
            with Live(screen(seen), console=console, auto_refresh=False, screen=True) as live:
                _follow(watch, ending, SHOW_EVERY_S, lambda now: live.update(screen(now), refresh=True))


class _Ending:
    """Flag for a requested end."""

    def __init__(self) -> None:
        self.asked = False

    def end(self) -> None:
        self.asked = True


def _line(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _first(watch: JointsWatch) -> Seen:
    """Return the first complete state. SourceError if there is none in time."""
    import time

    from bodyschema.interfaces.errors import SourceError

    end = time.monotonic() + FIRST_READING_S
    while time.monotonic() < end:
        if watch.look() is not None:
            watch.know_temperatures()
            seen = watch.look_all_over()
            if seen is not None:
                return seen
    raise SourceError("the joints cannot be read. `bodyschema doctor` tells why")


def _begin(watch: JointsWatch, force: Powered) -> None:
    """Switch zero-force on and print its answer. RequestError if it is refused."""
    answer = force.ask(True)
    while not answer.done():
        watch.look()
    sys.stderr.write(answer.result() + "\n")


def _follow(watch: JointsWatch, ending: _Ending, every_s: float, show: Callable[[Seen], None]) -> None:
    import time

    shown_at = 0.0
    while not ending.asked:
        seen = watch.look()
        if seen is not None and time.monotonic() - shown_at >= every_s:
            shown_at = time.monotonic()
            show(seen)
