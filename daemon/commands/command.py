"""`bodyschema command`."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from bodyschema.daemon.command_names import BOTHS, SAMPLERS, CommandName
from bodyschema.daemon.commands.options import HERE, RobotFile

Process = Literal["sampler", "learner"]


def command(
    name: Annotated[CommandName, Parameter(help="What to do.")],
    /,
    *,
    to: Annotated[
        Process | None,
        Parameter(help="Who is to do it; else who knows the command, and for pause, resume and reload the sampler."),
    ] = None,
    robot: RobotFile = HERE,
) -> None:
    """Tell a running process to do something.

    `pause` and `resume` accepting pairs (or, with --to learner, learning); `reload` reads robot.toml again and says
    what of it needs a new start; `zero_force_on` lets the servos bear the arm, `gaze_on` turns the head to the hand,
    `..._off` switches their torque off; `accept_turns` when a joint lost its turn count while its bus was away, and
    stands where the message says: the turn nearest to where it was is taken; `tool_changed` when another tool is in the
    hand; `rollback` goes back to the model before the last change; `reset_to_prior` forgets what was learnt, not the
    stored pairs; `checkpoint` writes the learner's state now.

    Needs: that process running (`bodyschema run`).

    Next: `bodyschema status`.
    """
    from rich.console import Console

    from bodyschema.daemon.bus import client
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.keys import Keys
    from bodyschema.daemon.wire import CommandReply, CommandRequest, decode, encode
    from bodyschema.interfaces.errors import RequestError

    process: Process = to or ("sampler" if name in SAMPLERS else "learner")
    if process == "sampler" and name not in SAMPLERS:
        raise RequestError(f"{name} is a command of the learner: drop --to")
    if process == "learner" and name in SAMPLERS and name not in BOTHS:
        raise RequestError(f"{name} is a command of the sampler: drop --to")
    config = Config.load(robot)
    with client(config.route(process)) as bus:
        reply = bus.ask_one(Keys(config.robot.name).command(process), encode(CommandRequest(name)))
    done = decode(reply, CommandReply)
    Console(highlight=False, soft_wrap=True).print(f"{process}: {done.message}", markup=False)
