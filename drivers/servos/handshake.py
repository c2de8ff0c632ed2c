"""Handshake before the first reading: identify the servos, compare them with robot.toml, and verify torque off."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from bodyschema.drivers.checks import aligned
from bodyschema.interfaces.errors import SourceError, SourceLost

from .bus import RETURN_DELAY_UNIT_S, Bus, Exchange, Request, Trouble
from .config import ServoConfig
from .model import Model, Register
from .servo import IdentifiedServo

log = logging.getLogger(__name__)

SETTINGS = ("return_delay", "drive_mode", "operating_mode", "homing_offset")


class HandshakeSettings:
    attempts: int = 5  # if one of six servos loses every twentieth answer, all five fail in one of 700 openings
    retry_s: float = 0.2  # after which opening is tried again


# What a busy machine or a loose cable does too; not a wrong ID, rate or setting.
TRANSIENT = (Trouble.TIMEOUT, Trouble.FOREIGN, Trouble.WRONG_LENGTH, Trouble.EARLY)
GARBLED = "garbled answers: two servos with this ID, or a bad cable"
SCAN = "`bodyschema scan --robot robot.toml` looks for them at all rates and IDs, and says what to do"


@dataclass(frozen=True, slots=True)
class Finding:
    """Finding for a configured servo."""

    config: ServoConfig
    found: str
    servo: IdentifiedServo | None = None
    may_come_back: bool = False


def identify(bus: Bus, config: ServoConfig, model: Model, known: Mapping[int, Model]) -> Finding:
    """Check that the servo of `config` is a `model`; `known` are the models that have a model number."""
    layout = model.layout
    head = Register(0, max(layout["model"].end, layout["firmware"].end))
    data, trouble = read_register(bus, model, config.id, head)
    if data is None:
        return Finding(config, _absence_reason(bus, model, config.id, trouble), may_come_back=trouble in TRANSIENT)
    number = layout.value("model", data)
    if number != model.number:
        other = known.get(number)
        return Finding(config, f"{other.name if other else f'model number {number}'}: wrong model")
    last = max(layout[name].end for name in SETTINGS if name in layout)
    table, trouble = read_register(bus, model, config.id, Register(0, last))
    if table is None:
        return Finding(config, _absence_reason(bus, model, config.id, trouble), may_come_back=True)
    if _is_garbled(bus, model, config.id):
        return Finding(config, GARBLED, may_come_back=True)
    servo = IdentifiedServo(
        joint=config.joint,
        bus=bus.name,
        id=config.id,
        model=model,
        direction=config.direction,
        zero_ticks=model.zero_ticks if config.zero_ticks is None else config.zero_ticks,
        firmware=layout.value("firmware", table),
        drive_mode=layout.value("drive_mode", table),
        operating_mode=layout.value("operating_mode", table),
        homing_offset=layout.value("homing_offset", table),
        return_delay_s=layout.value("return_delay", table) * RETURN_DELAY_UNIT_S,
    )
    bus.return_delay_s[config.id] = servo.return_delay_s
    return Finding(config, model.name, servo)


def require_all(findings: Iterable[Finding], ports: str) -> list[IdentifiedServo]:
    """Return the servos.

    Raises:
        SourceError: any is not as configured; the message has a table of all servos.
    """
    findings = list(findings)
    wrong = [finding for finding in findings if finding.servo is None]
    if not wrong:
        return [finding.servo for finding in findings if finding.servo is not None]
    rows = [("joint", "ID", "expected", "found")]
    rows += [(f.config.joint, str(f.config.id), f.config.model, f.found) for f in findings]
    message = "\n  ".join([f"the servos on {ports} are not those of robot.toml:", *aligned(rows), SCAN])
    if all(finding.may_come_back for finding in wrong):
        brief = "; ".join(f"joint {f.config.joint!r} (ID {f.config.id}): {f.found}" for f in wrong)
        raise SourceLost(message, retry_s=HandshakeSettings.retry_s, brief=brief)
    raise SourceError(message)


def switch_torque_off(bus: Bus, servo: IdentifiedServo) -> IdentifiedServo:
    """Switch the servo's torque off and verify it; return the servo with its former torque state.

    Raises:
        SourceLost: it does not answer.
        SourceError: the torque stays on.
    """
    had_torque = torque_is_on(bus, servo)
    if had_torque:
        register = servo.model.layout["torque"]
        for _ in range(HandshakeSettings.attempts):
            bus.write(servo.model, servo.id, register, register.bytes(0))
            if not torque_is_on(bus, servo):
                break
        else:
            raise SourceError(
                f"the torque of joint {servo.joint!r} (ID {servo.id}) stays on. "
                "Look for another program that moves the arm, and end it"
            )
    return replace(servo, had_torque=had_torque)


def torque_is_on(bus: Bus, servo: IdentifiedServo) -> bool:
    """Return True if the servo's torque is on; raise SourceLost if it does not answer."""
    data, trouble = read_register(bus, servo.model, servo.id, servo.model.layout["torque"])
    if data is None:
        raise SourceLost(f"joint {servo.joint!r} (ID {servo.id}): {trouble}", retry_s=HandshakeSettings.retry_s)
    return data != b"\x00"


def restore_torque(bus: Bus, servo: IdentifiedServo) -> None:
    """Restore torque that was on, with the present position as the goal."""
    layout = servo.model.layout
    position, trouble = read_register(bus, servo.model, servo.id, layout["position"])
    if position is None:
        log.warning("the torque of joint %r stays off: %s", servo.joint, trouble)
        return
    for register, data in ((layout["goal"], position), (layout["torque"], b"\x01")):
        bus.write(servo.model, servo.id, register, data)
    if not torque_is_on(bus, servo):
        log.warning("the torque of joint %r could not be switched on again", servo.joint)


def read_register(bus: Bus, model: Model, id: int, register: Register) -> tuple[bytes | None, Trouble | None]:
    """Return a register's bytes or the last trouble; repeat until two agree if the checksum is weak."""
    data, trouble = _read_once(bus, model, id, register)
    for _ in range(HandshakeSettings.attempts):
        if data is None or not bus.is_weak(bus.read_request(model, id, register)):
            break
        before = data
        data, trouble = _read_once(bus, model, id, register)
        if data == before:
            break
    return data, trouble


def _read_once(bus: Bus, model: Model, id: int, register: Register) -> tuple[bytes | None, Trouble | None]:
    exchange = ask_with_retries(bus, bus.read_request(model, id, register))
    return (exchange.answers[0].status.data if exchange.trouble is None else None), exchange.trouble


def ask_with_retries(bus: Bus, request: Request) -> Exchange:
    """Repeat a request until it is answered, a few times at most."""
    exchange = Exchange(())
    for _ in range(HandshakeSettings.attempts):
        exchange = bus.ask(request)
        if exchange.trouble is None:
            break
    return exchange


def _absence_reason(bus: Bus, model: Model, id: int, trouble: Trouble | None) -> str:
    if trouble is Trouble.TIMEOUT:
        if bus.ping(model, id).trouble is None:
            return bus.packets_of(model.protocol).pinged_only
        return "no answer"
    if trouble is Trouble.GARBLED:
        return GARBLED
    return str(trouble)


def _is_garbled(bus: Bus, model: Model, id: int) -> bool:
    """Return True if most measurements are garbled, as when two servos of one model, set up alike, share an ID."""
    request = bus.read_request(model, id, model.layout.block)
    garbled = sum(bus.ask(request).trouble is Trouble.GARBLED for _ in range(HandshakeSettings.attempts))
    return garbled > HandshakeSettings.attempts // 2
