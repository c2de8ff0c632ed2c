"""The command `bodyschema`. Commands and their parser are imported when they run, so that `--help` is fast."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Sequence

try:
    import resource
    import shutil
    from functools import cache
    from typing import TYPE_CHECKING, NoReturn

    from bodyschema.cli.front_page import ASCII, COMMANDS, GROUPS, HELP, UNICODE, front_page
    from bodyschema.daemon.service.remedies import as_typed, printable
    from bodyschema.daemon.service.signals import end_with_parent
    from bodyschema.interfaces.errors import BodyschemaError, ConfigError
except KeyboardInterrupt:  # loading takes a moment, in which no `main` can catch it
    sys.exit(130)

if TYPE_CHECKING:
    import cyclopts

# Names of earlier releases, for one more.
RENAMED = {
    ("config", "init"): ("init",),
    ("config", "check"): ("config",),
    ("config", "show"): ("config", "--json"),
    ("robot", "new"): ("init", "--from", "scan"),
    ("board",): ("calibrate", "cameras", "--print-board"),
    ("calibrate", "check"): ("calibrate", "cameras", "--check"),
    ("marker", "cluster"): ("marker", "learn"),
    ("sampler",): ("run", "sampler"),
    ("learner",): ("run", "learner"),
    ("joints",): ("watch", "joints"),
    ("servos", "show"): ("servos",),
    ("servos", "set"): ("servos",),
    ("servos", "zero"): ("servos", "--zero"),
    ("servos", "undo"): ("servos", "--undo"),
    ("restore",): ("backup", "--restore"),
    ("fleet", "list"): ("fleet",),
    ("fleet", "compare"): ("fleet", "--compare"),
    ("fleet", "diagnose"): ("fleet",),
    ("bench",): ("emulate",),
}
# In cli/commands/, a folder for each group.
_FOLDERS = dict(zip(GROUPS, ("start", "calibrate", "run", "hardware", "data"), strict=True))
MODULES = {
    name: f"bodyschema.cli.commands.{_FOLDERS[title]}.{name}" for title, group in GROUPS.items() for name in group
}


@cache
def _section(title: str) -> cyclopts.Group:
    """Return the group of commands with this title, always the same object: cyclopts refuses two of one title."""
    import cyclopts

    return cyclopts.Group(title, sort_key=list(GROUPS).index(title))


def command_line(called: str | None = None) -> cyclopts.App:
    """Return the command line.

    Args:
        called: the command whose own help page may be requested. A summary given here would replace that page, so this
            command is registered without one and shows its function's docstring.
    """
    import cyclopts

    line = cyclopts.App(
        name="bodyschema",
        help=HELP,
        version=_version,
        help_format="markdown" if called in COMMANDS else "plaintext",  # rendering markdown takes 0.1 s of CPU
    )
    line["--help"].group = line["--version"].group = cyclopts.Group("Options", sort_key=len(GROUPS))
    for title, commands in GROUPS.items():
        group = _section(title)
        for order, (name, summary) in enumerate(commands.items()):
            own = None if name == called else summary
            line.command(f"{MODULES[name]}:{name}", name=name, help=own, group=group, sort_key=order)
    return line


def present_names(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the command's present name, and print it if an earlier name was given."""
    for earlier, present in RENAMED.items():
        if tuple(arguments[: len(earlier)]) == earlier:
            rest = list(arguments[len(earlier) :])
            print(f"bodyschema {' '.join(earlier)} is now: bodyschema {' '.join(present)}", file=sys.stderr)  # noqa: T201
            return [present[0], *([] if "--from" in rest else present[1:]), *rest]
    return list(arguments)


def _version() -> str:
    from importlib.metadata import version

    return version("bodyschema")


def __getattr__(name: str) -> cyclopts.App:
    """Return `app`, the command line without a called command."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return globals().setdefault(name, command_line())


class _Settings:
    # A learner with two neighbours opens 26 files, one of fifty robots 200. Libraries abort when they cannot open more.
    min_files, enough_files = 64, 1024
    longest_message: int = 4000  # a message may quote a file: a key in quotes, a name in a model
    # Help pages put text beside names: where no column is left for the text, wrapping fails or never ends.
    narrowest: int = 20


RAISE_LIMIT = "`ulimit -n 1024` in the shell, or LimitNOFILE=1024 in the unit, allows more"


def allow_enough_files() -> None:
    """Raise this process's limit of open files to `enough_files`, as far as the system permits.

    Raises:
        ConfigError: the process may open fewer than `fewest_files`.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = _Settings.enough_files if hard == resource.RLIM_INFINITY else min(hard, _Settings.enough_files)
    if allowed < _Settings.min_files:
        raise ConfigError(f"this process may open {hard} files and needs {_Settings.min_files}", remedy=RAISE_LIMIT)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def prepare_streams() -> None:
    """Make standard streams of any kind usable: closed ones, encodings without our characters, terminals too narrow.

    Files and pipes get UTF-8, as programs expect; a terminal of another encoding shows `?` for missing characters.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:  # else a store would get the number of a closed stream
        pass
    os.close(descriptor)
    for name, number, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace") if stream.isatty() else stream.reconfigure(encoding="utf-8")
    columns = shutil.get_terminal_size().columns
    if columns < _Settings.narrowest or os.environ.get("COLUMNS") == "0":
        os.environ["COLUMNS"] = str(max(columns, _Settings.narrowest))


def _print_front_page() -> None:
    """Print the page of `--help` in colour on a terminal, unless the environment forbids it."""
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") not in ("dumb", "unknown")
    signs = UNICODE if sys.stdout.encoding.lower().startswith("utf") else ASCII
    sys.stdout.write(front_page(shutil.get_terminal_size().columns, colour=colour, signs=signs))


def _as_message(error: OSError) -> BodyschemaError:
    """Return an operating system's error, which no command handled, as an error of one line."""
    reason = error.strerror or str(error)
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return BodyschemaError(f"too many files and connections are open. {RAISE_LIMIT}")
    if error.filename is not None:
        return BodyschemaError(f"{os.fsdecode(error.filename)}: {reason}")
    if isinstance(error, FileNotFoundError):
        return BodyschemaError("the current folder was deleted. Change into another")
    return BodyschemaError(f"the output cannot be written: {reason}")


def _drop_output() -> None:
    """Discard the remaining output, which Python would otherwise try to write at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _fail(error: BodyschemaError) -> NoReturn:
    text = str(error)
    shortened = text if len(text) <= _Settings.longest_message else f"{text[: _Settings.longest_message]}..."
    print(f"bodyschema: {as_typed(printable(shortened))}", file=sys.stderr)  # noqa: T201
    sys.exit(1)


def main() -> None:
    """Run the command line; known errors become one line and exit code 1."""
    # BLAS threads spin on the small matrices of tracker and learner and double the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # OpenCV would allocate 3 GiB for a malicious PNG of a few kilobytes; the largest cameras have 100 megapixels.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))
    try:
        end_with_parent()
        prepare_streams()
        allow_enough_files()
        arguments = present_names(sys.argv[1:])
        try:
            if arguments in ([], ["--help"], ["-h"]):
                _print_front_page()
            else:
                command_line(arguments[0])(arguments)
        finally:
            sys.stdout.flush()
    except BodyschemaError as error:
        _fail(error)
    except ModuleNotFoundError as error:
        from bodyschema.interfaces.extras import missing_module

        missing = missing_module(error)
        if missing is None:
            raise
        _fail(missing)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader of our output has closed it, as `head` does
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        _fail(_as_message(error))


if __name__ == "__main__":
    main()
