"""Check a serial port: that it exists, may be opened, is not in use, and has a low-latency adapter."""

from __future__ import annotations

import grp
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from .serial_line import serial_ports


class CheckSettings:
    many_troubles: float = 0.01  # share of lost readings that deserves a warning
    read_s: float = 1.0  # how long a check of the rate lasts
    longest_latency_ms: int = 1  # of an adapter's latency timer


State = Literal["ok", "warning", "wrong"]
ROOT = Path("/")
LATENCY_TIMER = "sys/bus/usb-serial/devices/{}/latency_timer"
ENUMERATED = ("ttyUSB", "ttyACM")
PSEUDO_TERMINALS, MASTERS = "/dev/pts/", {"/dev/ptmx", "/dev/pts/ptmx"}


@dataclass(frozen=True, slots=True)
class Check:
    subject: str  # what was checked
    state: State  # "wrong" prevents reading the arm, "warning" degrades it
    said: str  # the finding
    fix: str = ""  # the command to type, or the remedy; empty if nothing needs doing


def warned(subject: str, said: str, fix: str, *, when: bool) -> Check:
    """Return a check that is a warning with a remedy if `when` is true, and passed otherwise."""
    return Check(subject, "warning", said, fix) if when else Check(subject, "ok", said)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table whose columns are aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


@dataclass(frozen=True, slots=True)
class Holder:
    """A process that has a port open."""

    pid: int
    command: str


def holders(port: str, root: Path = ROOT) -> list[Holder]:
    """Return the other processes that have `port` open, as far as this user may see them.

    For a pseudo-terminal the process that serves its other end is left out.
    """
    device = os.path.realpath(port)
    found = []
    for process in sorted((root / "proc").glob("[0-9]*"), key=lambda path: int(path.name)):
        if int(process.name) != os.getpid() and _has_open(process, device):
            found.append(Holder(int(process.name), _command(process)))
    return found


def _has_open(process: Path, device: str) -> bool:
    try:
        opened = {os.readlink(descriptor) for descriptor in (process / "fd").iterdir()}
    except OSError:  # the process has ended, or belongs to another user
        return False
    serves = device.startswith(PSEUDO_TERMINALS) and bool(opened & MASTERS)
    return device in opened and not serves


def _command(process: Path, longest: int = 60) -> str:
    try:
        words = (process / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return "?"
    command = " ".join(word.decode(errors="replace") for word in words if word)
    return f"{command[:longest]}…" if len(command) > longest else command or "?"


def port_checks(name: str, port: str, root: Path = ROOT, *, ours: Collection[int] = ()) -> Iterator[Check]:
    """Yield the checks of the port of the bus `name`. Open nothing.

    Args:
        root: of the file system, for /dev, /proc and /sys.
    """
    subject = f"port of {name}"
    if not os.path.exists(port):
        yield Check(subject, "wrong", f"{port} is not there", _where(root))
        return
    yield from _permission(subject, port)
    found = holders(port, root)
    others = [holder for holder in found if holder.pid not in ours]
    for holder in others:
        yield Check(subject, "wrong", f"{port} is open in process {holder.pid}: {holder.command}", f"kill {holder.pid}")
    if not others:
        who = "the running sampler has it open" if found else "no other program has it open"
        yield Check(subject, "ok", f"{port} is there, and {who}")
    yield from _naming(subject, port, root)
    yield from _latency(port, root)


def _where(root: Path) -> str:
    ports = serial_ports(root)
    if len(ports) == 1:
        return f'plug the adapter in, or set port = "{ports[0]}" in robot.toml'
    return "plug the adapter in, and compare with: ls -l /dev/serial/by-id"


def _permission(subject: str, port: str) -> Iterator[Check]:
    if os.access(port, os.R_OK | os.W_OK):
        return
    number = os.stat(port).st_gid
    try:
        group = grp.getgrgid(number).gr_name
    except KeyError:
        group = str(number)
    if number in os.getgroups():
        yield Check(subject, "wrong", f"{port} may not be opened by its group {group}", "bodyschema install udev")
        return
    yield Check(
        subject,
        "wrong",
        f"{port} may not be opened: you are not in the group {group}",
        f"sudo usermod -aG {group} $USER    # then log in again",
    )


def _naming(subject: str, port: str, root: Path) -> Iterator[Check]:
    """Yield a warning if the port's name may change when it is plugged in again."""
    if not Path(port).name.startswith(ENUMERATED):
        return
    by_id = [name for name in serial_ports(root) if os.path.realpath(name) == os.path.realpath(port) and name != port]
    if by_id:
        message = f"{port} may have another name when it is plugged in again"
        yield Check(subject, "warning", message, f'set port = "{by_id[0]}" in robot.toml')


def _latency(port: str, root: Path) -> Iterator[Check]:
    device = Path(os.path.realpath(port)).name
    file = root / LATENCY_TIMER.format(device)
    try:
        latency_ms = int(file.read_text())
    except (OSError, ValueError):
        return
    message = f"the adapter keeps bytes back for up to {latency_ms} ms"
    fix = "bodyschema install udev    # then plug the adapter in again"
    yield warned("latency timer", message, fix, when=latency_ms > CheckSettings.longest_latency_ms)
