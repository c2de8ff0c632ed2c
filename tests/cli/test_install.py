"""`bodyschema install udev`."""

from __future__ import annotations

import io
import os
import re

import pytest

from bodyschema.cli.install import machine_files
from bodyschema.cli.install.machine_files import ADAPTERS, FILE, UdevRules, rules
from bodyschema.cli.main import command_line
from bodyschema.interfaces.errors import ConfigError

# One key, operator and value of a rule; see udev(7).
TERM = re.compile(r'[A-Z_]+(\{[A-Za-z_]+\})?(==|=|\+=)"[^"]*"')


def install(*arguments: object) -> None:
    command_line("install")(
        ["install", "udev", *map(str, arguments)], exit_on_error=False, result_action="return_value"
    )


def test_every_line_is_a_comment_or_a_rule() -> None:
    lines = [line for line in rules().splitlines() if line and not line.startswith("#")]
    assert len(lines) == 1 + len(ADAPTERS)
    assert [line for line in lines if not all(TERM.fullmatch(term) for term in line.split(", "))] == []


def test_the_latency_timer_becomes_1_ms() -> None:
    assert 'DRIVER=="ftdi_sio", ATTR{latency_timer}="1"' in rules()


def test_yes_writes_the_file(tmp_path, capsys) -> None:
    install("--yes", "--root", tmp_path)
    assert (tmp_path / FILE).read_text() == rules()
    assert rules() in capsys.readouterr().out


def test_a_dry_run_shows_it_and_writes_nothing(tmp_path, capsys) -> None:
    install("--dry-run", "--root", tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert rules() in capsys.readouterr().out


@pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("n\n", False), ("\n", False)])
def test_without_yes_it_asks(tmp_path, monkeypatch, answer, written) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    install("--root", tmp_path)
    assert (tmp_path / FILE).exists() == written


def test_existing_udev_rules_are_left_unchanged(tmp_path, capsys) -> None:
    install("--yes", "--root", tmp_path)
    os.utime(tmp_path / FILE, (0, 0))
    install("--root", tmp_path)
    assert "there already" in capsys.readouterr().out
    assert ((tmp_path / FILE).read_text(), (tmp_path / FILE).stat().st_mtime) == (rules(), 0)


def test_uninstall_removes_the_file(tmp_path, capsys) -> None:
    install("--yes", "--root", tmp_path)
    install("--uninstall", "--yes", "--root", tmp_path)
    assert (tmp_path / FILE.parent).is_dir()  # the system's, even if it is empty now
    assert not (tmp_path / FILE).exists()
    assert "Removed." in capsys.readouterr().out


def test_a_dry_run_of_uninstall_removes_nothing(tmp_path) -> None:
    install("--yes", "--root", tmp_path)
    install("--uninstall", "--dry-run", "--root", tmp_path)
    assert (tmp_path / FILE).exists()


def test_rules_under_another_root_do_not_reload_udev(tmp_path) -> None:
    ran: list[object] = []
    rules_file = UdevRules(tmp_path, ran.append)
    rules_file.install(rules_file.texts())
    assert ran == []


def test_unwritable_rules_file_error_names_sudo_command(tmp_path, monkeypatch) -> None:
    (tmp_path / "etc").write_text("no folder")
    monkeypatch.setattr(machine_files.os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match=r"sudo .* install udev --yes$"):
        UdevRules(tmp_path).install(UdevRules(tmp_path).texts())
