"""Examples in docs/hardware.md agree with the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from bodyschema.cli.hardware.bench_run import FAULTS
from bodyschema.cli.main import command_line
from bodyschema.drivers.config import DriversConfig
from bodyschema.drivers.dynamixel.bench.arm import KINDS as DYNAMIXEL_KINDS
from bodyschema.drivers.dynamixel.models import BY_NAME, Register
from bodyschema.drivers.feetech.bench.arm import KINDS as FEETECH_KINDS
from bodyschema.drivers.feetech.models import LAYOUT_SCS, LAYOUT_STS
from bodyschema.drivers.serial_lines.bench.arm import KINDS as LINE_KINDS
from bodyschema.drivers.serial_lines.lines import Header, Reading, parse

PAGE = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text()
SHOWN = ("XM430-W350", "PH54-200-S500", "MX-28")
ROWS = {
    "model, firmware": ("model", "firmware"),
    "Return Delay Time": ("return_delay",),
    "Drive Mode, Operating Mode, Homing Offset": ("drive_mode", "operating_mode", "homing_offset"),
    "Torque Enable": ("torque",),
    "Goal Position": ("goal",),
}


def block(language: str, about: str = "") -> str:
    for found in re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL):
        if about in found:
            return found
    raise KeyError(about)


@pytest.mark.parametrize("uncommented", [False, True])
@pytest.mark.parametrize("driver", ["dynamixel", "feetech", "serial_lines"])
def test_the_tables_for_robot_toml_are_accepted_also_with_all_keys(driver, uncommented) -> None:
    shown = block("toml", driver)
    text = re.sub(r"^# (?=[a-z_]+ =)", "", shown, flags=re.MULTILINE) if uncommented else shown
    config = msgspec.convert(tomllib.loads(text)["drivers"], DriversConfig)
    config.check(["shoulder"], Path("robot.toml"), text)
    assert getattr(config, driver) is not None


@pytest.mark.parametrize("driver", ["feetech", "serial_lines"])
def test_the_defaults_of_other_drivers_that_are_shown_are_the_defaults(driver) -> None:
    shown = block("toml", driver)
    plain = getattr(msgspec.convert(tomllib.loads(shown)["drivers"], DriversConfig), driver)
    for key, value in re.findall(r"^# (\w+) = (\S+)", shown.partition("\n\n")[0], flags=re.MULTILINE):
        assert getattr(plain, key) == tomllib.loads(f"value = {value}")["value"]


def test_the_lines_that_are_shown_are_lines() -> None:
    found = re.search(r"For example `(.*)` and `(.*)`", PAGE)
    assert found is not None
    assert isinstance(parse(found[1].encode()), Header)
    assert parse(found[2].encode()) == Reading(12, 3456789, (1023, None))


FEETECH_ROWS = {
    "firmware, model": ("firmware", "model"),
    "return delay": ("return_delay",),
    "phase, homing offset, operating mode": ("drive_mode", "homing_offset", "operating_mode"),
    "torque": ("torque",),
    "goal position": ("goal",),
}


@pytest.mark.parametrize("row", FEETECH_ROWS)
def test_the_table_of_feetech_registers_has_their_addresses(row) -> None:
    line = next(line for line in PAGE.splitlines() if line.startswith(f"| {row} |"))
    cells = [cell.strip() for cell in line.split("|")][2:4]
    for cell, layout in zip(cells, (LAYOUT_STS, LAYOUT_SCS), strict=True):
        assert cell == ", ".join(str(layout[name].address) for name in FEETECH_ROWS[row] if name in layout)


def test_the_defaults_that_are_shown_are_the_defaults() -> None:
    shown = tomllib.loads(re.sub(r"^# (?=(rate|max|restore)[a-z_]* =)", "", block("toml"), flags=re.MULTILINE))
    table = shown["drivers"]["dynamixel"]
    plain = msgspec.convert({**tomllib.loads(block("toml"))["drivers"]["dynamixel"]}, type=type_of_table())
    for key in ("rate_hz", "max_speed_deg_s", "max_move_deg", "restore_torque"):
        assert table[key] == getattr(plain, key)


def type_of_table():
    from bodyschema.drivers.dynamixel.config import DynamixelConfig

    return DynamixelConfig


def test_the_bench_starts_as_shown(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    exec(block("python", "speak to"), {})
    assert capsys.readouterr().out == "speak to bus\n"


@pytest.mark.parametrize("row", ROWS)
def test_the_table_of_registers_has_their_addresses(row) -> None:
    line = next(line for line in PAGE.splitlines() if line.startswith(f"| {row} |"))
    cells = [cell.strip() for cell in line.split("|")][2:5]
    for cell, model in zip(cells, SHOWN, strict=True):
        layout = BY_NAME[model].layout
        known = [str(layout[name].address) for name in ROWS[row] if name in layout]
        assert cell == (", ".join(known) or "–")


def test_the_blocks_are_where_the_table_says() -> None:
    def span(register: Register) -> str:
        return f"{register.address} … {register.end - 1}"

    for layout in (LAYOUT_STS, LAYOUT_SCS):
        assert f"| {span(layout.block)} |" in PAGE
    for model in SHOWN:
        assert f"| {span(BY_NAME[model].layout.block)} |" in PAGE


@pytest.mark.parametrize("command", re.findall(r"^\$ (bodyschema .*)$", PAGE, re.MULTILINE))
def test_every_command_on_the_page_is_understood(command) -> None:
    words = command.split()[1:]
    command_line(words[0]).parse_args(words, exit_on_error=False, print_error=False)


def test_the_table_of_faults_is_that_of_the_bench() -> None:
    body = re.search(r"^\| fault \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert body is not None
    rows = re.findall(r"^\| `([a-z-]+)` \| (.*) \|$", body[1], re.MULTILINE)
    assert dict(rows) == dict(FAULTS)
    assert set(FAULTS) == {kind for kinds in (DYNAMIXEL_KINDS, FEETECH_KINDS, LINE_KINDS) for kind in kinds.names}
