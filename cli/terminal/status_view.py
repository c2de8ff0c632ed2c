"""Query the two processes' states and show them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Self

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from bodyschema.cli.terminal.findings_view import calibration_table, outlook_lines
from bodyschema.cli.terminal.screen import coverage_table, degrees, mm, or_dash, rejected
from bodyschema.daemon.client_config import ClientConfig
from bodyschema.daemon.service.remedies import as_typed
from bodyschema.daemon.transport.identity import Route
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import UNDECIDED, LearnerStatus, SamplerStatus
from bodyschema.daemon.transport.wire import decode
from bodyschema.daemon.transport.zenoh_config import PROCESSES
from bodyschema.interfaces.errors import BusError, RequestError
from bodyschema.interfaces.servos import BusStatus, ServoStatus
from bodyschema.interfaces.waits import Waits
from bodyschema.learning.status import OrientationStatus


@dataclass(frozen=True, slots=True)
class ProcessStates:
    """States of the processes; None for one that did not answer."""

    sampler: SamplerStatus | None
    learner: LearnerStatus | None

    @property
    def nobody(self) -> bool:
        """True if neither answered."""
        return self.sampler is None and self.learner is None


class Watcher:
    """Observer of the states of both processes. Use as a context manager; the processes may come and go."""

    def __init__(self, config: ClientConfig) -> None:
        self._keys = Keys(config.name)
        self._routes = {process: config.route(process) for process in PROCESSES}
        self._sessions: dict[str, ZenohSession] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in list(self._sessions):
            self._leave(process)

    def look(self) -> ProcessStates:
        """Return their current states."""
        sampler, learner = self._ask("sampler"), self._ask("learner")
        return ProcessStates(
            sampler=None if sampler is None else decode(sampler, SamplerStatus),
            learner=None if learner is None else decode(learner, LearnerStatus),
        )

    def follow(self) -> Iterator[ProcessStates]:
        """Yield their states about once a second, without end."""
        while True:
            yield self.look()
            time.sleep(Waits.status_every_s)

    def _ask(self, process: str) -> bytes | None:
        try:
            if process not in self._sessions:
                self._sessions[process] = ZenohSession(connect=self._routes[process], client=True).__enter__()
            return self._sessions[process].ask_one(self._keys.status(process), timeout_s=Waits.answer_limit_s)
        except (BusError, RequestError):
            self._leave(process)
            return None

    def _leave(self, process: str) -> None:
        session = self._sessions.pop(process, None)
        if session is not None:
            session.__exit__(None, None, None)


def as_json(seen: ProcessStates) -> str:
    """Return both states as one line of JSON."""
    return msgspec.json.encode({"schema": 1, "sampler": seen.sampler, "learner": seen.learner}).decode()


def screen(seen: ProcessStates, config: ClientConfig) -> RenderableType:
    """Return a screen of both states; a small terminal cuts off the end of the joints' coverage."""
    parts: list[RenderableType] = []
    parts += _absent("sampler", config.route("sampler")) if seen.sampler is None else _sampler(seen.sampler)
    parts.append(Text())
    names = () if seen.nobody else zip(config.joints, config.slides, strict=True)
    slides = {name for name, slides in names if slides}
    parts += _absent("learner", config.route("learner")) if seen.learner is None else _learner(seen.learner)
    if seen.learner is not None and seen.learner.calibration is not None:
        parts += [Text(), calibration_table(seen.learner.calibration, slides)]
    if seen.sampler is not None and seen.sampler.coverage:
        parts += [Text(), coverage_table(seen.sampler, slides)]
    return Group(*parts)


def _absent(process: str, route: Route) -> list[RenderableType]:
    message = f"does not answer on {route}. Start it with `bodyschema run {process}`, or both with `bodyschema run`."
    return [Text.assemble((process, "bold"), " ", (as_typed(message), "yellow"))]


def _sampler(status: SamplerStatus) -> list[RenderableType]:
    reasons = ", ".join(f"{count} {reason}" for reason, count in rejected(status)) or "none"
    segments = f"{status.segment} segment{'' if status.segment == 1 else 's'}"
    facts = _facts()
    facts.add_row("samples", f"{status.pairs} in {segments}, {status.pairs_per_s:.1f}/s")
    facts.add_row("frames", f"{status.frames}, {status.frames_per_s:.1f}/s; readings {status.readings_per_s:.0f}/s")
    facts.add_row("rejected", reasons)
    for name, bus in status.buses.items():
        facts.add_row(f"bus {name}", _bus(bus))
    facts.add_row("store", f"{status.store}, {status.disk_free_bytes / 1e9:.1f} GB free")
    servos = [Text(), servos_table(status.servos)] if status.servos else []
    return [_head("sampler", status), facts, *_health(status.health), *servos]


def _bus(bus: BusStatus) -> str:
    wrong = ", ".join(f"{count} × {name}" for name, count in sorted(bus.troubles.items(), key=lambda item: -item[1]))
    way = f"{bus.way}; " if bus.way else ""
    return f"{way}{bus.answered:.2%} of {bus.exchanges} questions answered{f': {wrong}' if wrong else ''}"


def _learner(status: LearnerStatus) -> list[RenderableType]:
    errors = ", ".join(f"{name} {mm(error)}" for name, error in status.prequential_m.items()) or "-"
    saved = "none yet" if status.checkpoint_age_s is None else f"{status.checkpoint_age_s:.0f} s ago"
    doubted = f", {status.doubted} doubted" if status.doubted else ""
    refused = f", {status.refused} refused" if status.refused else ""
    facts = _facts()
    facts.add_row("samples", f"{status.pairs} learnt, {status.replayed} replay steps{doubted}{refused}")
    if status.behind:
        age = "" if status.age_s is None else f"; the newest learnt is {_duration(status.age_s)} old"
        facts.add_row("", f"{status.behind} stored and not learnt yet{age}")
    facts.add_row("new samples", f"missed by: {errors}")
    if status.prequential_pairs:
        facts.add_row("", f"mean of the last {status.prequential_pairs}, measurement noise included")
    facts.add_row("expected", _expected(status))
    if status.orientation is not None:
        facts.add_row("orientation", _orientation(status.orientation))
    if status.changes:
        for number, line in enumerate(_change(status)):
            facts.add_row("" if number else "change", line)
    for name, line in zip(("enough?", ""), outlook_lines(status.outlook), strict=False):
        facts.add_row(name, line)
    facts.add_row("answering", f"{status.answering}, model {status.model or 'none yet'}")
    facts.add_row("checkpoint", saved)
    return [_head("learner", status), facts, *_health(status.health)]


def _expected(status: LearnerStatus) -> str:
    """Return the errors on new pairs that the learner expects."""
    if (here_m := status.expected_error_m(status.claimed_error_m)) is None:
        return "not known yet"
    anywhere_m = None if status.outlook is None else status.expected_error_m(status.outlook.anywhere_m)
    text = f"{mm(here_m)} where data is" + ("" if anywhere_m is None else f", {mm(anywhere_m)} over all joints' ranges")
    shared = "" if status.common_error_m is None else f"; {mm(status.common_error_m)} in all: camera calibration"
    return text + shared


def _change(status: LearnerStatus) -> Iterator[str]:
    since, change = f"{status.pairs_since_change} samples since", status.last_change
    if change is None:
        # Rolled back, or learning was restarted.
        yield f"none in force of {status.changes} reported or detected; {status.pairs_since_change} samples count"
        return
    when = f"at sample {change.first_seq}"
    if change.earliest_seq < change.latest_seq:
        when += f" ({change.earliest_seq} to {change.latest_seq})"
    moved = "" if change.moved_m is None else f", marker moved by {mm(change.moved_m)}"
    yield f"{change.kind} {when}{moved} ({'found' if change.found else 'told'}); {since}"
    if change.kind == UNDECIDED:
        yield ", ".join(f"{kind} {share:.0%}" for kind, share in change.probabilities.items())
    elif change.alike is not None:
        yield f"or {change.alike}: no motion separates them"
    if change.can_roll_back:
        yield as_typed("`bodyschema command rollback` goes back to the model before it")


def _facts() -> Table:
    facts = Table.grid(padding=(0, 2))
    facts.add_column(no_wrap=True, min_width=len("checkpoint"), style="dim")
    return facts


def _head(process: str, status: SamplerStatus | LearnerStatus) -> Text:
    colour = "red" if status.state == "failed" else "yellow" if status.state == "paused" else "green"
    return Text.assemble(
        (process, "bold"), f" of {status.robot} is ", (status.state, colour), f", up for {_duration(status.uptime_s)}"
    )


def _health(sentences: list[str]) -> list[RenderableType]:
    return [Text(f"! {as_typed(sentence)}", style="yellow") for sentence in sentences]


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {seconds:02d} s" if minutes else f"{seconds} s"


def _orientation(status: OrientationStatus) -> str:
    errors = ", ".join(f"{name} {degrees(error)}" for name, error in status.prequential_rad.items())
    return (
        f"{status.answering} answers, of {status.pairs} samples; new samples: {errors}; "
        f"claimed {degrees(status.claimed_rad)} from the truth where data is"
    )


def servos_table(servos: Mapping[str, ServoStatus]) -> Table:
    """Return a table of each joint's servo: identity, health, and problems in the last column."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for heading in ("servo", "ID", "model", "fw", "supply", "temp.", "current", "state"):
        right = heading in ("ID", "fw", "supply", "temp.", "current")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading != "state")
    for joint, servo in servos.items():
        figures = (
            or_dash(servo.voltage_v, "{:.1f} V"),
            or_dash(servo.temperature_c, "{:.0f} °C"),
            or_dash(servo.current_a, "{:.2f} A"),
        )
        short = ", ".join(trouble.split(":")[0] for trouble in servo.troubles)  # the remedies are above the table
        state = Text(short, style="red") if short else Text("well", style="green")
        table.add_row(joint, str(servo.id), servo.model, str(servo.firmware), *figures, state)
    return table
