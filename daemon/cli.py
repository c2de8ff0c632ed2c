"""The command `bodyschema`. Commands are imported when they run, so that `--help` answers at once."""

from __future__ import annotations

import errno
import os
import resource
import sys
from typing import NoReturn

import cyclopts

from bodyschema.daemon.extras import missing_module
from bodyschema.daemon.remedies import as_typed, printable
from bodyschema.daemon.signals import end_with_parent
from bodyschema.interfaces.errors import BodyschemaError, ConfigError

COMMANDS = {
    "demo": "Watch it all in simulation, about a minute. No hardware needed.",
    "config": "Write, check or show robot.toml: begin here with your robot.",
    "replay": "Learn a recording; prints the error before and after.",
    "calibrate": "Camera, tool, joint zeros from pairs; or two cameras.",
    "board": "The page to print that cameras are calibrated with.",
    "diagnose": "What the simulation gets wrong, why, and how it gets better.",
    "simulate": "What the simulation would have measured at the same angles.",
    "compare": "How far two recordings are apart, row by row.",
    "reproduce": "Run the paper's experiments again, its figures beside ours.",
    "scan": "Which servos are there: all ports, rates and protocols.",
    "doctor": "Ports, servos, disk, clock, zenoh: what to mend, and how.",
    "install": "On this machine: services for systemd, rules for ports.",
    "robot": "robot new: a robot.toml for the servos that were found.",
    "marker": "Tags to print, a cluster measured, a ball's colour learnt.",
    "joints": "Angles live while you move the arm: signs, ranges, health.",
    "watch": "watch cameras: what they see, in a browser or as files.",
    "servos": "What servos keep without power: show, set, zero, undo.",
    "bench": "Your servos without the arm: a dry run of robot.toml.",
    "run": "Start sampler and learner, and keep them running.",
    "sampler": "Only the sampler: encoders and cameras in, pairs out.",
    "learner": "Only the learner: pairs in, answers out. On any machine.",
    "router": "Where machines meet: TLS, and who may do what.",
    "status": "What both processes do and found, and if it is enough.",
    "fleet": "Many robots: who is there, which unit is off, and why.",
    "view": "A page: errors, where to move next, residuals, buttons.",
    "predict": "Ask where the marker is at given joint angles.",
    "ik": "Ask for joint angles that bring the marker to a position.",
    "command": "Pause, resume, tell of a changed tool, reset, checkpoint.",
    "record": "Copy the running sampler's pairs into a file.",
    "export": "A store or a recording into CSV, Parquet, MCAP or Rerun.",
    "backup": "Pairs, checkpoint and description in one file, while running.",
    "restore": "Put a backup back, verified; overwrites nothing unasked.",
}


# Each paragraph is one line: the terminal's width breaks it.
_HELP = """Calibrate a robot arm by moving it by hand in front of a camera.

Joint encoders and a stereo camera give samples. A learner turns them into the forward kinematics that the camera \
sees, hand-eye and tool included.

New here? Type: bodyschema demo. Each command's --help says what it needs and what comes next."""


def command_line(called: str | None = None) -> cyclopts.App:
    """The command line.

    Args:
        called: the command whose own page may be asked for. A summary given here is all that such a page would show,
            so this command is registered without one and shows what its function says of itself.
    """
    line = cyclopts.App(
        name="bodyschema",
        help=_HELP,
        version=_version,
        help_format="markdown" if called in COMMANDS else "plaintext",  # rendering markdown takes 0.1 s of CPU
    )
    for place, (name, summary) in enumerate(COMMANDS.items()):
        own = None if name == called else summary
        line.command(f"bodyschema.daemon.commands.{name}:{name}", name=name, help=own, sort_key=place)
    return line


def _version() -> str:
    from importlib.metadata import version

    return version("bodyschema")


app = command_line()

# A learner with two neighbours opens 26 files, one of fifty robots 200. Libraries abort where they get none.
FEWEST_FILES, ENOUGH_FILES = 64, 1024
RAISE_LIMIT = "`ulimit -n 1024` in the shell, or LimitNOFILE=1024 in the unit, allows more"


def allow_enough_files() -> None:
    """Raise this process's limit of open files to `ENOUGH_FILES`, as far as it may.

    Raises:
        ConfigError: it may open fewer than `FEWEST_FILES`.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = ENOUGH_FILES if hard == resource.RLIM_INFINITY else min(hard, ENOUGH_FILES)
    if allowed < FEWEST_FILES:
        raise ConfigError(f"this process may open {hard} files and needs {FEWEST_FILES}", remedy=RAISE_LIMIT)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def _fail(error: BodyschemaError) -> NoReturn:
    print(f"bodyschema: {as_typed(printable(str(error)))}", file=sys.stderr)  # noqa: T201
    sys.exit(1)


def main() -> None:
    """Run the command line; errors of ours become one line and exit code 1."""
    # Threads of BLAS spin on the small matrices of tracker and learner, and take twice the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # OpenCV would take 3 GiB for what a few kilobytes of PNG call an image; the largest cameras have 100 megapixels.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))
    end_with_parent()
    arguments = sys.argv[1:]
    try:
        allow_enough_files()
        command_line(arguments[0] if arguments else None)(arguments)
    except BodyschemaError as error:
        _fail(error)
    except ModuleNotFoundError as error:
        missing = missing_module(error)
        if missing is None:
            raise
        _fail(missing)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # whoever read our output has had enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.errno not in (errno.EMFILE, errno.ENFILE):
            raise
        print(f"bodyschema: too many files and connections are open. {RAISE_LIMIT}", file=sys.stderr)  # noqa: T201
        sys.exit(1)


if __name__ == "__main__":
    main()
