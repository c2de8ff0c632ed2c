"""Examples in docs/hardware.md agree with the code."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from bodyschema.cli.hardware.emulator_run import FAULTS
from bodyschema.cli.main import command_line
from bodyschema.drivers.config import DriversConfig
from bodyschema.drivers.dynamixel.emulator.arm import KINDS as DYNAMIXEL_KINDS
from bodyschema.drivers.dynamixel.models import BY_NAME as DYNAMIXEL_MODELS
from bodyschema.drivers.feetech.emulator.arm import KINDS as FEETECH_KINDS
from bodyschema.drivers.feetech.models import BY_NAME as FEETECH_MODELS
from bodyschema.drivers.serial_lines.emulator.arm import KINDS as LINE_KINDS
from bodyschema.drivers.serial_lines.lines import Header, Reading, parse

PAGE = (Path(__file__).parents[2] / "docs" / "hardware.md").read_text()


def block(language: str, about: str = "") -> str:
    for found in re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL):
        if about in found:
            return found
    raise KeyError(about)


@pytest.mark.parametrize("uncommented", [False, True])
@pytest.mark.parametrize("driver", ["dynamixel", "feetech", "serial_lines"])
def test_documented_tables_are_accepted_with_all_keys(driver, uncommented) -> None:
    shown = block("toml", driver)
    text = re.sub(r"^# (?=[a-z_]+ =)", "", shown, flags=re.MULTILINE) if uncommented else shown
    config = msgspec.convert(tomllib.loads(text)["drivers"], DriversConfig)
    config.check(["shoulder"], Path("robot.toml"), text)
    assert getattr(config, driver) is not None


@pytest.mark.parametrize("driver", ["feetech", "serial_lines"])
def test_documented_driver_defaults_match_the_code(driver) -> None:
    shown = block("toml", driver)
    plain = getattr(msgspec.convert(tomllib.loads(shown)["drivers"], DriversConfig), driver)
    for key, value in re.findall(r"^# (\w+) = (\S+)", shown.partition("\n\n")[0], flags=re.MULTILINE):
        assert getattr(plain, key) == tomllib.loads(f"value = {value}")["value"]


def test_the_lines_that_are_shown_are_lines() -> None:
    found = re.search(r"For example `(.*)` and `(.*)`", PAGE)
    assert found is not None
    assert isinstance(parse(found[1].encode()), Header)
    assert parse(found[2].encode()) == Reading(12, 3456789, (1023, None))


def test_emulator_starts_as_shown(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    exec(block("python", "speak to"), {})
    assert capsys.readouterr().out == "speak to bus\n"


@pytest.mark.parametrize("command", re.findall(r"^\$ (bodyschema .*)$", PAGE, re.MULTILINE))
def test_every_command_on_the_page_is_understood(command) -> None:
    words = command.split()[1:]
    understood, *_ = command_line(words[0]).parse_args(words, exit_on_error=False, print_error=False)
    assert callable(understood)


def test_faults_listed_are_emulators_faults() -> None:
    assert set(FAULTS) == {kind for kinds in (DYNAMIXEL_KINDS, FEETECH_KINDS, LINE_KINDS) for kind in kinds.names}


@pytest.mark.parametrize("series", [DYNAMIXEL_MODELS, FEETECH_MODELS])
def test_every_supported_model_is_on_the_page(series) -> None:
    assert [name for name in series if re.findall(r"[A-Z]+", name)[0] not in PAGE] == []
