"""`bodyschema emulate`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.options import HERE, RobotFile, flag, say, several
from bodyschema.daemon.service.signals import on_termination
from bodyschema.interfaces.waits import Waits

if TYPE_CHECKING:
    from bodyschema.cli.hardware.emulator_run import EmulatorRun

PORT = Path("bus")


def emulate(
    *,
    port: Annotated[Path, Parameter(help="The name of the port to make; PORT-BUS for each of several buses.")] = PORT,
    robot: RobotFile = HERE,
    fault: Annotated[tuple[str, ...], several("KIND[@JOINT][=SHARE], as in late=0.05 or overload@elbow")] = (),
    list_faults: Annotated[bool, flag("Show the kinds of faults and end.", name="--list-faults")] = False,
    return_delay_us: Annotated[
        int, Parameter(help="Return Delay Time of the servos; the factory's is 500.", validator=Number(gte=0, lte=508))
    ] = 0,
    seed: Annotated[int, Parameter(help="Of the faults' dice.", validator=Number(gte=0))] = 0,
) -> None:
    """Emulate the servos of robot.toml on a port that any program can open like a real one. Ends with Ctrl-C.

    The servos are those of `[drivers.dynamixel]` or `[drivers.feetech]`, the encoders those of
    `[drivers.serial_lines]`, with their timing and protocol rules. The simulated hand guides the arm; without pybullet
    each joint swings slowly. PORT.toml is written next to PORT for the other commands: your robot.toml with the
    emulator's port and a state of its own. Both files are removed at the end.

    Needs: robot.toml with servos (`bodyschema init --from scan`) or encoders, no hardware.

    Next: in another terminal `bodyschema scan`, `doctor` or `watch joints`, each with --robot PORT.toml.
    """
    from bodyschema.cli.hardware.emulator_run import FAULTS, EmulatorRun
    from bodyschema.daemon.config import Config

    console = Console(highlight=False, soft_wrap=True)
    if list_faults:
        say(*(f"{kind:12} {meaning}" for kind, meaning in FAULTS.items()))
        return
    config = Config.load(robot)
    run = EmulatorRun(config, port, faults=fault, return_delay_s=return_delay_us * 1e-6, seed=seed)
    with on_termination(run.stop), _made(run, console) as opened:
        say(*opened.introduction())
        _look_on(opened, console)


def _made(run: EmulatorRun, console: Console) -> EmulatorRun:
    """Prepare the emulator's motion, which takes a moment; return the emulator."""
    if not console.is_terminal:
        run.prepare(lambda _: None)
        return run
    with console.status("guiding the simulated arm") as status:
        run.prepare(lambda share: status.update(f"guiding the simulated arm: {100 * share:.0f} %"))
    return run


def _look_on(run: EmulatorRun, console: Console) -> None:
    with console.status("nothing has gone over the wire yet") as status:
        while not run.stopping:
            for said in run.due():
                console.print(said, markup=False)
            if run.count:
                status.update(f"{run.count:,} {run.unit}")
            time.sleep(Waits.poll_s)
