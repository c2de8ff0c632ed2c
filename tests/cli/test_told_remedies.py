"""Commands in messages have the --robot that was given."""

from __future__ import annotations

import logging
import sys

import pytest
from rich.console import Console

from bodyschema.cli.hardware.doctor import show
from bodyschema.daemon.service.logs import PlainFormatter
from bodyschema.daemon.service.remedies import WITH_ROBOT, as_typed, given_robot, printable
from bodyschema.daemon.wiring.servos import Check

GIVEN = ["doctor", "--robot", "arm/left.toml"]


@pytest.mark.parametrize(
    ("arguments", "robot"),
    [
        (GIVEN, "arm/left.toml"),
        (["doctor", "--robot=left.toml"], "left.toml"),
        (["doctor"], None),
        (["doctor", "--robot"], None),
    ],
)
def test_robot_option_is_found_in_either_spelling(arguments, robot) -> None:
    assert given_robot(arguments) == robot


@pytest.mark.parametrize(
    ("said", "typed"),
    [
        ("Ask: `bodyschema command gaze_on`", "Ask: `bodyschema command gaze_on --robot arm/left.toml`"),
        ("`bodyschema scan --robot robot.toml` looks", "`bodyschema scan --robot arm/left.toml` looks"),
        ("`bodyschema run`, `bodyschema run --sim`",
         "`bodyschema run --robot arm/left.toml`, `bodyschema run --sim --robot arm/left.toml`"),
        ("bodyschema scan --robot robot.toml    # who is there",
         "bodyschema scan --robot arm/left.toml    # who is there"),
        ("bodyschema calibrate latency", "bodyschema calibrate latency --robot arm/left.toml"),
        ("`bodyschema calibrate cameras`", "`bodyschema calibrate cameras`"),
        ("bodyschema install udev    # then plug in", "bodyschema install udev    # then plug in"),
        ("sudo usermod -aG dialout $USER", "sudo usermod -aG dialout $USER"),
    ],
)  # fmt: skip
def test_a_command_that_takes_it_has_it(said, typed) -> None:
    assert as_typed(said, GIVEN) == typed


def test_message_stays_unchanged_without_robot_option() -> None:
    assert as_typed("`bodyschema scan --robot robot.toml`", ["doctor"]) == "`bodyschema scan --robot robot.toml`"


def test_a_name_with_blanks_can_be_typed() -> None:
    assert as_typed("`bodyschema doctor`", ["run", "--robot", "my arm.toml"]) == (
        "`bodyschema doctor --robot 'my arm.toml'`"
    )


@pytest.mark.parametrize("command", sorted(WITH_ROBOT))
def test_each_of_these_commands_takes_it(command, capsys) -> None:
    from bodyschema.cli.main import command_line

    words = command.split()
    command_line(words[0])([*words, "--help"], exit_on_error=False, result_action="return_value")
    assert "--robot" in capsys.readouterr().out


def test_doctor_and_the_log_say_it(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["bodyschema", *GIVEN])
    show(Console(width=80), [Check("servos", "wrong", "none answers", "bodyschema watch joints    # live")])
    assert "bodyschema watch joints --robot arm/left.toml    # live" in capsys.readouterr().out
    record = logging.LogRecord("x", logging.INFO, "", 0, "see `bodyschema status`", None, None)
    assert PlainFormatter("%(message)s").format(record) == "see `bodyschema status --robot arm/left.toml`"


def test_no_name_in_a_message_steers_the_terminal() -> None:
    assert printable("a joint '\x1b[2J\rwaist\x00'\nis not there: Gelenk ä") == (
        "a joint '\\x1b[2J\\rwaist\\x00'\nis not there: Gelenk ä"
    )
