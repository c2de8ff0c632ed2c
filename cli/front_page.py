"""The page of `bodyschema --help`, without the packages that parse command lines: they take 0.2 s of CPU to import."""

from __future__ import annotations

import textwrap

GROUPS = {
    "Start": {
        "demo": "Learn a simulated arm from scratch, in about a minute.",
        "init": "Write robot.toml: begin here.",
        "config": "Check or show robot.toml.",
        "doctor": "Check ports, servos, disk, clock and network.",
    },
    "Calibrate and diagnose": {
        "calibrate": "Calibrate arm, hand-eye and tool, or cameras.",
        "diagnose": "Find what the simulation gets wrong, and the causes.",
        "replay": "Learn from a recording; report the held-out error.",
        "simulate": "Predict the marker for recorded joint angles.",
        "compare": "Compare two recordings row by row.",
        "marker": "Print tags; learn a cluster's shape or a ball's colour.",
        "reproduce": "Run the paper's experiments again.",
    },
    "Run": {
        "run": "Run sampler and learner, or one of them.",
        "status": "Show the state of sampler and learner.",
        "view": "Serve a live page: errors, next poses, controls.",
        "predict": "Predict the marker position at given joint angles.",
        "ik": "Find joint angles that bring the marker to a position.",
        "command": "Pause, resume, report a tool change, reset.",
        "install": "Install systemd services, or udev rules.",
        "router": "Run the zenoh router that connects several machines.",
    },
    "Hardware": {
        "scan": "Find servos on all ports, rates and protocols.",
        "watch": "Show joints, cameras or other marker sources live.",
        "servos": "Read and write servo EEPROM settings, with undo.",
        "emulate": "Emulate the servos of robot.toml on a port.",
    },
    "Data and fleet": {
        "record": "Save the running sampler's samples to a file.",
        "export": "Convert samples or a robot: CSV, Parquet, MCAP, MJCF, URDF.",
        "backup": "Save samples, checkpoint and robot.toml, or restore them.",
        "fleet": "List, compare and diagnose many robots.",
    },
}
COMMANDS = {name: summary for group in GROUPS.values() for name, summary in group.items()}
OPTIONS = {"--help (-h)": "Display this message and exit.", "--version": "Display application version."}
# Each paragraph is one line: the terminal's width wraps it.
HELP = """Calibrate a robot arm by moving it by hand in front of a camera.

Joint encoders and one or two cameras give samples. A learner turns them into the forward kinematics that the cameras \
see, hand-eye and tool included.

New here? Type: bodyschema demo. Each command's --help says what it needs and what comes next."""

# Corners, lines and posts of a panel.
UNICODE, ASCII = "╭╮╰╯─│", "++++-|"
BOLD, CYAN, PLAIN = "\x1b[1m", "\x1b[36m", "\x1b[0m"


def front_page(width: int, *, colour: bool = False, signs: str = UNICODE) -> str:
    """Return the page, as wide as the terminal. The command line prints the same one, from the same texts.

    Args:
        width: columns of the terminal, at least 20.
        colour: with ANSI escape sequences.
        signs: characters for drawing panels.
    """
    bold, plain = (BOLD, PLAIN) if colour else ("", "")
    lines = [f"{bold}{line}{plain}" for line in textwrap.wrap("Usage: bodyschema COMMAND", width)]
    for paragraph in HELP.split("\n\n"):
        lines += ["", *textwrap.wrap(paragraph, width, break_on_hyphens=False)]
    lines.append("")
    for title, entries in {**GROUPS, "Options": OPTIONS}.items():
        lines += _panel(title, entries, width, colour, signs)
    return "\n".join(lines) + "\n"


def _panel(title: str, entries: dict[str, str], width: int, colour: bool, signs: str) -> list[str]:
    cyan, plain = (CYAN, PLAIN) if colour else ("", "")
    names = max(map(len, entries))
    text = width - names - 6
    inside = f" {title[: width - 6]} "
    lines = [f"{signs[0]}{signs[4]}{inside}".ljust(width - 1, signs[4]) + signs[1]]
    for name, summary in entries.items():
        for row, part in enumerate(textwrap.wrap(summary, text, break_on_hyphens=False)):
            shown = "" if row else name
            lines.append(f"{signs[5]} {cyan}{shown:{names}}{plain}  {part:{text}} {signs[5]}")
    return [*lines, f"{signs[2]}{signs[4] * (width - 2)}{signs[3]}"]
