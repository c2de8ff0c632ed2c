"""Terminal view of the fleet's roster."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import mm
from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.transport.zenoh_config import PROCESSES

from .roster import Member


def as_json(members: Sequence[Member]) -> str:
    """Return the robots as one line of JSON: name, live processes, both states (null without an answer), health."""
    return msgspec.json.encode(
        [
            {
                "robot": member.name,
                "alive": sorted(member.alive),
                "health": member.health,
                "sampler": member.sampler,
                "learner": member.learner,
            }
            for member in members
        ]
    ).decode()


def screen(members: Sequence[Member], unreached: Sequence[str]) -> RenderableType:
    """Return a table with one row per robot, then the problems."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("robot", overflow="fold")
    table.add_column("state", no_wrap=True)
    for name in ("pairs", "a second", "error", "claimed"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("answers", no_wrap=True)
    table.add_column("health", justify="right", no_wrap=True)
    for member in members:
        table.add_row(*_row(member))
    wrong = [f"{member.name}: {sentence}" for member in members for sentence in member.health] + list(unreached)
    lines = [Text(f"! {as_typed(sentence)}", style="yellow") for sentence in wrong]
    return Group(table, *([Padding(Group(*lines), (1, 0, 0, 0))] if lines else []))


def _row(member: Member) -> tuple[RenderableType, ...]:
    sampler, learner, wrong = member.sampler, member.learner, len(member.health)
    pairs = learner.pairs if learner is not None else None if sampler is None else sampler.pairs
    return (
        Text(member.name),
        _state(member),
        "-" if pairs is None else f"{pairs}",
        "-" if sampler is None else f"{sampler.pairs_per_s:.1f}",
        mm(member.error_m),
        mm(None if learner is None else learner.claimed_error_m),
        "-" if learner is None else learner.answering,
        Text(f"{wrong} wrong", style="yellow") if wrong else Text("well", style="green"),
    )


def _state(member: Member) -> Text:
    if not member.alive:
        return Text("absent", style="red")
    if member.learner is not None:
        colour = "yellow" if member.learner.state == "paused" else "green"
        return Text(member.learner.state, style=colour)
    alone = [process for process in PROCESSES if process in member.alive]
    return Text(f"{' and '.join(alone)} only" if len(alone) == 1 else "silent", style="yellow")
