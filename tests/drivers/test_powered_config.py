"""[drivers.dynamixel.zero_force] and [drivers.dynamixel.gaze] of robot.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec
import pytest

from bodyschema.drivers.config import DriversConfig
from bodyschema.drivers.dynamixel.models import BY_NAME, MODELS
from bodyschema.drivers.dynamixel.powered_config import TORQUE_AT_CURRENT
from bodyschema.interfaces.errors import ConfigError

SERVOS = """
[drivers.dynamixel]
{settings}
[drivers.dynamixel.buses.arm]
port = "bus"
[[drivers.dynamixel.servos]]
joint = "shoulder"
id = 1
model = "{model}"
[[drivers.dynamixel.servos]]
joint = "elbow"
id = 2
model = "XM430-W350"
{tables}
"""
FLOAT = "[drivers.dynamixel.zero_force.joints.{joint}]\ncurrent_limit_a = 1.5\n{more}"
GAZE = "[drivers.dynamixel.gaze]\njoints = ['{joint}']\n{more}"


def check(tables: str, *, model: str = "XM430-W350", settings: str = "") -> DriversConfig:
    text = SERVOS.format(model=model, settings=settings, tables=tables)
    config = msgspec.convert(tomllib.loads(text)["drivers"], DriversConfig)
    config.check(["shoulder", "elbow"], Path("robot.toml"), text)
    return config


def floating(joint: str = "shoulder", more: str = "") -> str:
    return FLOAT.format(joint=joint, more=more)


def gazing(joint: str = "shoulder", more: str = "") -> str:
    return GAZE.format(joint=joint, more=more)


def test_nothing_has_torque_by_default() -> None:
    dynamixel = check("").dynamixel
    assert dynamixel is not None
    assert (dynamixel.zero_force, dynamixel.gaze) == (None, None)


@pytest.mark.parametrize("model", ["XL430-W250", "AX-12A", "MX-28", "MX-106", "MX-28(2.0)", "XC430-W240"])
def test_servo_without_current_control_error_names_joint(model) -> None:
    with pytest.raises(ConfigError, match=r"joint 'shoulder': a .* has no current control") as refused:
        check(floating(), model=model)
    assert model in str(refused.value)


def test_an_unknown_torque_constant_has_to_be_given() -> None:
    with pytest.raises(ConfigError, match=r"the torque constant of a XW540-H260 is not known"):
        check(floating(), model="XW540-H260")
    check(floating(more="torque_constant = 3.7"), model="XW540-H260")


@pytest.mark.parametrize(
    ("tables", "settings", "message"),
    [
        (floating("shoudler"), "", "there is no joint 'shoudler'.*shoulder"),
        (gazing("neck"), "", "there is no joint 'neck'"),
        (floating() + gazing(), "", "joint 'shoulder' is in zero_force too"),
        (floating(), "restore_torque = true", "restore_torque switches torque on again"),
        (floating(), "rate_hz = 20", "rate_hz = 20 is too slow for its heartbeat"),
        (gazing(more="limits_deg = { elbow = [-10, 10] }"), "", "'elbow' is not one of its joints"),
        (gazing(more="limits_deg = { shoulder = [10, -10] }"), "", "the lower limit is not below the upper"),
    ],
)
def test_mistake_is_reported_with_its_line(tables, settings, message) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        check(tables, settings=settings)
    assert refused.value.line is not None


@pytest.mark.parametrize("model", ["AX-12A", "MX-28"])
def test_a_head_without_watchdog_is_refused(model) -> None:
    with pytest.raises(ConfigError, match="has no watchdog"):
        check(gazing(), model=model)


@pytest.mark.parametrize(
    ("tables", "key"), [(floating(more="curent_limit = 3"), "curent_limit"), (gazing(more="speed = 3"), "speed")]
)
def test_an_unknown_key_is_an_error(tables, key) -> None:
    with pytest.raises(msgspec.ValidationError, match=key):
        check(tables)


@pytest.mark.parametrize(("heartbeat_ms", "watchdog"), [(20, 1), (100, 5), (101, 6), (2540, 127)])
def test_the_watchdog_is_no_shorter_than_the_heartbeat(heartbeat_ms, watchdog) -> None:
    config = check(floating() + f"[drivers.dynamixel.zero_force]\nheartbeat_ms = {heartbeat_ms}\n").dynamixel
    assert config is not None
    assert config.zero_force is not None
    assert config.zero_force.watchdog == watchdog


def test_one_current_controlled_model_lacks_a_torque_constant() -> None:
    able = {model.name for model in MODELS if model.protocol == 2 and model.current_unit is not None}
    assert able - set(TORQUE_AT_CURRENT) == {"XW540-H260"}  # as in docs/zero_force.md


def test_torque_constants_belong_to_current_controlled_servos() -> None:
    for name in TORQUE_AT_CURRENT:
        assert BY_NAME[name].current_unit is not None
        torque, current = TORQUE_AT_CURRENT[name]
        assert 0.1 < torque / current < 6
