"""Roster of the fleet: robots found by their liveliness tokens, with the status of their processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self, TypeVar

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.screen import mm
from bodyschema.daemon.config import Config
from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.transport.identity import SECURE, Route
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.daemon.transport.zenoh_config import ENDPOINT, PROCESSES
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.waits import Waits

EVERYBODY = "*"

Status = TypeVar("Status", SamplerStatus, LearnerStatus)


@dataclass(frozen=True)
class Place:
    """Network route that is searched for robots."""

    route: Route
    robots: tuple[str, ...] = ()  # names of the expected robots; others are found too if queries for all are permitted


@dataclass(eq=False)
class Member:
    """Current state of one robot of the fleet."""

    name: str  # of the robot
    alive: set[str] = field(default_factory=set)  # its processes that are alive
    # sampler, learner: their status; None if one did not answer
    sampler: SamplerStatus | None = None
    learner: LearnerStatus | None = None
    route: Route | None = None  # the learner's route, else the sampler's; None if neither was found

    @property
    def joints(self) -> tuple[str, ...] | None:
        """Names of its joints; None if no process reports them."""
        if self.sampler is not None and self.sampler.coverage:
            return tuple(self.sampler.coverage)
        if self.learner is not None and self.learner.calibration is not None:
            return tuple(self.learner.calibration.zeros)
        return None

    @property
    def error_m(self) -> float | None:
        """Recent mean distance between the answering model's predictions and the measurements [m]."""
        return None if self.learner is None else self.learner.prequential_m.get(self.learner.answering)

    @property
    def health(self) -> list[str]:
        """Problems, as sentences; empty if there are none."""
        said = [sentence for status in (self.sampler, self.learner) if status is not None for sentence in status.health]
        if not self.alive:
            return ["neither its sampler nor its learner is alive"]
        for process, status in zip(PROCESSES, (self.sampler, self.learner), strict=True):
            if process in self.alive and status is None:
                said.append(f"the {process} is alive and does not answer")
        if "learner" not in self.alive:
            said.append("its learner is not alive: nothing learns or answers")
        return said


def places(endpoints: Sequence[str], files: Sequence[Path]) -> list[Place]:
    """Return the routes to search: endpoints of routers or processes, and those in descriptions of robots, each once.

    Raises:
        RequestError: something is not an endpoint, or it needs certificates, which only a description names.
        ConfigError: a description is wrong.
    """
    found: dict[Route, set[str]] = {}
    for endpoint in endpoints:
        if not ENDPOINT.fullmatch(endpoint):
            raise RequestError(f"--connect {endpoint}: this is no endpoint. Write one like tcp/127.0.0.1:7447")
        if endpoint.startswith(SECURE):
            raise RequestError(
                f"--connect {endpoint} takes certificates. Give --robot with a robot.toml whose [zenoh] has this "
                "router and them (docs/security.md)"
            )
        found.setdefault(Route((endpoint,)), set())
    for file in files:
        config = Config.load(file)
        zenoh, identity = config.tables.zenoh, config.tables.zenoh.identity(file.parent)
        for endpoint in [zenoh.router] if zenoh.router else [zenoh.learner, zenoh.sampler]:
            found.setdefault(Route((endpoint,), identity), set()).add(config.robot.name)
    return [Place(route, tuple(sorted(names))) for route, names in found.items()]


class Fleet:
    """All robots, with queries of their status. Use as a context manager; robots and routes may come and go."""

    def __init__(self, places: Sequence[Place]) -> None:
        self._places = places
        self._sessions: dict[Route, ZenohSession] = {}
        self._open = ExitStack()
        self.unreachable: list[str] = []  # reasons why routes could not be queried the last time

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def poll(self) -> list[Member]:
        """Return the robots now, by name; raise BusError if none of the routes can be reached."""
        members = {name: Member(name) for place in self._places for name in place.robots}
        self.unreachable = []
        for place in self._places:
            try:
                self._poll_place(place, members)
            except BusError as error:
                self.unreachable.append(str(error))
        if len(self.unreachable) == len(self._places):
            raise BusError(self.unreachable[0])
        return [members[name] for name in sorted(members)]

    def bus(self, route: Route) -> ZenohSession:
        """Return the session of a route; raise BusError if no process answers there."""
        if route not in self._sessions:
            self._sessions[route] = self._open.enter_context(ZenohSession(connect=route, client=True))
        return self._sessions[route]

    def _poll_place(self, place: Place, members: dict[str, Member]) -> None:
        bus = self.bus(place.route)
        asked = [EVERYBODY]
        tokens = bus.alive(Keys(EVERYBODY).alive(EVERYBODY), timeout_s=Waits.answer_limit_s)
        if not tokens:  # no process answers, or only queries by name are permitted
            asked = list(place.robots)
            tokens = [token for name in asked for token in bus.alive(Keys(name).alive(EVERYBODY))]
        if not tokens:
            return
        for token in tokens:
            _, name, _, process = token.split("/")
            member = members.setdefault(name, Member(name))
            member.alive.add(process)
            if process == "learner" or member.route is None:
                member.route = place.route
        for who in asked:
            for sampler in _states(bus, who, "sampler", SamplerStatus):
                members.setdefault(sampler.robot, Member(sampler.robot)).sampler = sampler
            for learner in _states(bus, who, "learner", LearnerStatus):
                members.setdefault(learner.robot, Member(learner.robot)).learner = learner


def _states(bus: ZenohSession, robots: str, process: str, kind: type[Status]) -> Iterator[Status]:
    for reply in bus.ask(Keys(robots).status(process), timeout_s=Waits.answer_limit_s):
        if reply.error is None:
            with suppress(RequestError):  # another version's message counts as no answer
                yield decode(reply.payload, kind)


def as_json(members: Sequence[Member]) -> str:
    """Return the robots as one line of JSON: name, live processes, both states (null without an answer), health."""
    return msgspec.json.encode(
        [
            {
                "schema": 1,
                "robot": member.name,
                "alive": sorted(member.alive),
                "health": member.health,
                "sampler": member.sampler,
                "learner": member.learner,
            }
            for member in members
        ]
    ).decode()


def screen(members: Sequence[Member], unreachable: Sequence[str]) -> RenderableType:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("robot", overflow="fold")
    table.add_column("state", no_wrap=True)
    for name in ("samples", "a second", "error", "expected"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("answers", no_wrap=True)
    table.add_column("health", justify="right", no_wrap=True)
    for member in members:
        table.add_row(*_row(member))
    wrong = [f"{member.name}: {sentence}" for member in members for sentence in member.health] + list(unreachable)
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
        mm(None if learner is None else learner.expected_error_m(learner.claimed_error_m)),
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
