"""`bodyschema command`."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from bodyschema.cli.commands.options import HERE, RobotFile, flag, print_json, say
from bodyschema.daemon.transport.keys import BOTHS, SAMPLERS, CommandName
from bodyschema.interfaces.errors import RequestError

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
    as_json: Annotated[bool, flag("Print the result as JSON.", name="--json")] = False,
) -> None:
    """Send a command to a running process.

    `pause` and `resume` stop and restart accepting samples (or, with --to learner, learning). `reload` reads robot.toml
    again and lists the settings that need a restart. `zero_force_on` lets the servos hold the arm, `gaze_on` turns the
    head to the hand, and `..._off` switches their torque off. `accept_turns` is for a joint that lost its turn count
    while its bus was away, if it is at the position in the message: it assumes the turn nearest to its last position.
    `tool_changed` reports a tool change; `rollback` restores the model before the last change; `reset_to_prior`
    discards the learnt model, but not the stored samples; `checkpoint` writes the learner's state now.

    Needs: that process running (`bodyschema run`).

    Next: `bodyschema status`.
    """
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.daemon.transport.keys import Keys
    from bodyschema.daemon.transport.session import client
    from bodyschema.daemon.transport.wire import CommandReply, CommandRequest, decode, encode

    process: Process = to or ("sampler" if name in SAMPLERS else "learner")
    if process == "sampler" and name not in SAMPLERS:
        raise RequestError(f"{name} is a command of the learner: drop --to")
    if process == "learner" and name in SAMPLERS and name not in BOTHS:
        raise RequestError(f"{name} is a command of the sampler: drop --to")
    config = ClientConfig.load(robot)
    with config.checked_on_error(), client(config.route(process)) as bus:
        reply = bus.ask_one(Keys(config.name).command(process), encode(CommandRequest(name)))
    done = decode(reply, CommandReply)
    if as_json:
        print_json(done)
        return
    say(f"{process}: {done.message}")
