"""The command `bodyschema`. Commands are imported when they run, so that `--help` answers at once."""

from __future__ import annotations

import sys
from importlib.metadata import version

import cyclopts

from interfaces.errors import BodyschemaError

COMMANDS = {
    "demo": "Watch the whole thing learn, in simulation, in about a minute.",
    "run": "Start sampler and learner for a robot. Needs robot.toml; next: `status --watch`.",
    "sampler": "Only the process beside the hardware: encoders and camera in, pairs out.",
    "learner": "Only the process that learns and answers; it may run on another machine.",
    "predict": "Ask the learner where the marker is at given joint angles.",
    "status": "What the two processes are doing. Needs one of them running.",
    "command": "Pause, resume, tell of a changed tool, reset, or write a checkpoint.",
    "replay": "Feed a recording through sampler and learner; prints the error before and after.",
    "record": "Copy the running sampler's pairs into a file. Needs a running sampler.",
    "export": "Turn a store or a recording into CSV, Parquet or MCAP.",
    "config": "Write, check or show robot.toml.",
}


def command_line(called: str | None = None) -> cyclopts.App:
    """The command line.

    Args:
        called: the command whose own page may be asked for. A summary given here is all that such a page would show,
            so this command is registered without one and shows what its function says of itself.
    """
    line = cyclopts.App(
        name="bodyschema",
        help="""Robot kinematics that calibrates itself.

        Guide the arm by hand: encoders and a stereo camera give pairs, a learner turns them into the forward
        kinematics that the cameras see. New here? Try `bodyschema demo`: it needs no hardware.
        """,
        version=lambda: version("bodyschema"),
        help_format="markdown",
    )
    for place, (name, summary) in enumerate(COMMANDS.items()):
        own = None if name == called else summary
        line.command(f"daemon.commands.{name}:{name}", name=name, help=own, sort_key=place)
    return line


app = command_line()


def main() -> None:
    """Run the command line; errors of ours become one line and exit code 1."""
    try:
        command_line(sys.argv[1] if len(sys.argv) > 1 else None)()
    except BodyschemaError as error:
        print(f"bodyschema: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
