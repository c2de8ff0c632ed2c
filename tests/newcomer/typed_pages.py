"""Pages of the docs whose commands are typed."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

from bodyschema.cli.main import command_line

DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class TypedPage:
    """A page whose commands are typed in the working directory.

    Attributes:
        text: of the page.
        printed: terminal output.
    """

    text: str
    printed: pytest.CaptureFixture[str]

    @property
    def commands(self) -> list[str]:
        """All commands of the page, in their order."""
        return commands_of(self.text)

    def shown(self, command: str) -> str:
        """Return what the page shows under a command."""
        found = re.search(rf"```console\n\$ {re.escape(command)}\n(.*?)```", self.text, re.DOTALL)
        assert found is not None, command
        return found[1]

    def type(self, command: str) -> str:
        """Type a command of the page, and return its output with unwrapped lines."""
        assert command in self.commands, command
        words = shlex.split(command)[1:]
        self.printed.readouterr()
        command_line(words[0])(words, exit_on_error=False, result_action="return_value")
        return self.printed.readouterr().out


def commands_of(text: str) -> list[str]:
    """Return the commands that a page shows."""
    return re.findall(r"^\$ (bodyschema .*)$", text, re.MULTILINE)


def command_of(words: str) -> str:
    """Return the module of the command that the typed words run; raise if an option or a value is refused."""
    arguments = shlex.split(words)[1:]
    return command_line(arguments[0]).parse_args(arguments, exit_on_error=False, print_error=False)[0].__module__


def expected_mm(text: str) -> tuple[float, float]:
    """Return the errors on new poses that a text tells: the mean, and what 95 % stay within [mm]."""
    told = re.search(r"Expect ([\d.]+) mm on new\s+poses, 95 % ≤ ([\d.]+) mm", text)
    assert told is not None, text
    return float(told[1]), float(told[2])
