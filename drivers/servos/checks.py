"""Check an arm's servos and the reading rate they allow. Nothing is written: torque stays unchanged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise, zip_longest
from statistics import median, quantiles
from typing import Any

from bodyschema.drivers.checks import Check, CheckSettings, warned
from bodyschema.drivers.echo import without_echo
from bodyschema.interfaces.errors import SourceError
from bodyschema.interfaces.protocols import Clock

from .bus import Bus, Request
from .config import ServosConfig
from .handshake import Finding, ask_with_retries, identify
from .joints import OpenPort, open_serial
from .servo import IdentifiedServo
from .vendor import ServoVendor, plans_of


class _Settings:
    identify_s: float = 1.0  # servos not yet asked by then are not asked any more
    few_per_s: float = 100.0  # readings: fewer get a warning
    longest_delay_s: float = 50e-6  # of a servo's answers
    fast_baud: int = 1_000_000  # a slower bus is the reason for few readings [bit/s]


TYPE = "servos"


def servo_checks(
    vendor: ServoVendor,
    config: ServosConfig[Any],
    clock: Clock,
    open_port: OpenPort = open_serial,
    *,
    read_s: float = CheckSettings.read_s,
) -> Iterator[Check]:
    """Yield checks of presence, health and reading rate of the servos. Open the ports for that."""
    with ExitStack() as stack:
        buses: dict[str, Bus] = {}
        try:
            for name, bus in config.buses.items():
                port, latency_s = open_port(bus, clock)
                stack.callback(port.close)
                buses[name] = vendor.bus(name, without_echo(port, clock, latency_s), clock, latency_s)
            found = _identified(vendor, config, buses, clock)
            yield from _presence(found)
            servos = [finding.servo for finding in found if finding.servo is not None]
            for servo in servos:
                yield from _health(vendor, buses[servo.bus], servo)
            yield from _delays(servos)
            if servos:
                yield from _pace(vendor, config, buses, servos, clock, read_s)
        except SourceError as error:
            yield Check(TYPE, "wrong", str(error))


def _identified(vendor: ServoVendor, config: ServosConfig[Any], buses: dict[str, Bus], clock: Clock) -> list[Finding]:
    found: list[Finding] = []
    end = clock.now() + _Settings.identify_s
    for servo in config.servos:
        if clock.now() > end:
            found.append(Finding(servo, "not asked"))
        else:
            found.append(identify(buses[config.bus_of(servo)], servo, config.model_of(servo), vendor.models))
    return found


def _presence(found: Sequence[Finding]) -> Iterator[Check]:
    missing = [finding for finding in found if finding.servo is None]
    for finding in missing:
        config = finding.config
        message = f"joint {config.joint} (ID {config.id}, {config.model}): {finding.found}"
        yield Check(TYPE, "wrong", message, "bodyschema scan --robot robot.toml    # who is there instead")
    if not missing:
        yield Check(TYPE, "ok", f"all {len(found)} answer, each of the model that robot.toml names")


def _health(vendor: ServoVendor, bus: Bus, servo: IdentifiedServo) -> Iterator[Check]:
    layout = servo.model.layout
    exchange = ask_with_retries(bus, bus.read_request(servo.model, servo.id, layout.state))
    if exchange.trouble is not None:
        message = f"joint {servo.joint} (ID {servo.id}) does not report its state: {exchange.trouble}"
        yield Check(TYPE, "wrong", message, "look at cable and connectors, then bodyschema doctor once more")
        return
    has_torque, bits = layout.torque_and_errors(exchange.answers[0].status)
    for bit, text in vendor.errors.items():
        if bits & bit:
            message, _, fix = text.partition(": ")
            yield Check(TYPE, "wrong", f"joint {servo.joint} (ID {servo.id}): {message}", fix)
    if has_torque:
        yield Check(TYPE, "ok", f"joint {servo.joint} holds its place: `bodyschema run` switches its torque off")


def _delays(servos: Sequence[IdentifiedServo]) -> Iterator[Check]:
    for name in dict.fromkeys(servo.bus for servo in servos):
        slow = [s for s in servos if s.bus == name and s.return_delay_s > _Settings.longest_delay_s]
        if slow:
            worst_us = 1e6 * max(servo.return_delay_s for servo in slow)
            names = ", ".join(servo.joint for servo in slow)
            message = f"{names}: each answer comes {worst_us:.0f} µs late by Return Delay Time"
            yield Check(TYPE, "warning", message, f"bodyschema servos return_delay=0 --bus {name}")


def _pace(
    vendor: ServoVendor,
    config: ServosConfig[Any],
    buses: dict[str, Bus],
    servos: Sequence[IdentifiedServo],
    clock: Clock,
    read_s: float,
) -> Iterator[Check]:
    """Read at the highest rate for a while; yield a check of the rate reached."""
    plans = plans_of(vendor, buses, servos, config)
    requests = {name: plan.requests for name, plan in plans.items()}
    before = {name: (bus.counts.exchanges, dict(bus.counts.troubles)) for name, bus in buses.items()}
    end, times = clock.now() + read_s, [clock.now()]
    while clock.now() < end:
        if _read_all(buses, requests):
            times.append(clock.now())
    yield _rate(times, read_s, config)
    for name, plan in plans.items():
        yield from (Check(TYPE, "warning", f"{name}: {complaint}") for complaint in plan.complaints)
    for name, bus in buses.items():
        exchanges, troubles = before[name]
        new = {t.value: n - troubles.get(t, 0) for t, n in bus.counts.troubles.items() if n > troubles.get(t, 0)}
        yield _troubles(name, bus.counts.exchanges - exchanges, new)


def _read_all(buses: dict[str, Bus], requests: dict[str, list[Request]]) -> bool:
    is_whole = True
    for questions in zip_longest(*requests.values()):
        requested = [(bus, question) for bus, question in zip(buses.values(), questions, strict=True) if question]
        for bus, question in requested:
            bus.send(question)
        for bus, question in requested:
            is_whole &= bus.collect(question).trouble is None
    return is_whole


def _rate(times: Sequence[float], read_s: float, config: ServosConfig[Any]) -> Check:
    rate, wanted_hz = (len(times) - 1) / read_s, config.rate_hz
    if len(times) < 4:
        return Check("rate", "wrong", "no reading of all servos came through", "look at cable, supply and baud rates")
    intervals = [b - a for a, b in pairwise(times)]
    jitter_ms = 1e3 * (quantiles(intervals, n=20)[-1] - median(intervals))
    message = f"{rate:.0f} readings/s are possible ({wanted_hz:.0f} wanted), jitter {jitter_ms:.1f} ms (95 %)"
    slow = next((name for name, bus in config.buses.items() if bus.baud < _Settings.fast_baud), None)
    faster = "bodyschema install udev    # an adapter's latency timer; then plug it in again"
    fix = faster if slow is None else f"bodyschema servos baud={_Settings.fast_baud} --bus {slow}"
    return warned("rate", message, fix, when=rate < min(_Settings.few_per_s, wanted_hz))


def _troubles(name: str, exchanges: int, troubles: dict[str, int]) -> Check:
    count = sum(troubles.values())
    words = ", ".join(f"{n}× {what}" for what, n in sorted(troubles.items(), key=lambda item: -item[1]))
    message = f"{count} of {exchanges} questions on {name} went wrong{f': {words}' if words else ''}"
    fix = "look at cable and connectors, the supply's voltage under load, noise"
    return warned("errors", message, fix, when=count > CheckSettings.many_troubles * exchanges)
