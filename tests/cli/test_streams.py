"""Standard streams and terminals of any kind: closed, full, of another encoding, without a width."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import warm
from small_arm import write_small_arm

CALLED = (sys.executable, "-P", "-m", "bodyschema")


def run(command: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a line of a shell, in which $B is bodyschema; without PYTHONUNBUFFERED, which hides what is written late."""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    env |= {"B": " ".join(CALLED), **environment}
    return subprocess.run(["sh", "-c", command], capture_output=True, cwd=cwd, env=env, timeout=500, check=False)


@pytest.mark.parametrize("command", ["--version", "config --json"])
def test_full_disk_under_stdout_gives_one_line(tmp_path: Path, command: str) -> None:
    write_small_arm(tmp_path)
    done = run(f"$B {command} > /dev/full", tmp_path)
    assert (done.returncode, done.stderr) == (1, b"bodyschema: the output cannot be written: No space left on device\n")


def test_closed_streams_do_no_harm(tmp_path: Path) -> None:
    write_small_arm(tmp_path)
    done = run("$B config --json <&- >&-", tmp_path)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_pipe_gets_utf8_whatever_the_locale(tmp_path: Path) -> None:
    write_small_arm(tmp_path)
    done = run("$B config", tmp_path, PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, b"")
    assert "°" in done.stdout.decode()


@pytest.mark.parametrize("columns", ["0", "1"])
def test_help_is_shown_however_narrow_the_terminal(tmp_path: Path, columns: str) -> None:
    done = warm.run("-m", "bodyschema", "demo", "--help", cwd=tmp_path, env=os.environ | {"COLUMNS": columns})
    assert (done.returncode, "Usage" in done.stdout) == (0, True)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("mkdir gone; cd gone; rmdir ../gone; exec $B backup a.zip --robot ../robot.toml", "folder was deleted"),
        pytest.param(
            f"$B simulate --like a.csv --out {'n' * 300}.csv", "nnn.csv: File name too long", marks=pytest.mark.soak
        ),
    ],
)
def test_unexpected_system_error_gives_one_line(tmp_path: Path, command: str, said: str) -> None:
    robot = write_small_arm(tmp_path)
    (tmp_path / "a.csv").write_text("waist,shoulder,x,y,z\n0,0,1,2,3\n")
    done = run(command, tmp_path, BODYSCHEMA_ROBOT=str(robot))
    assert (done.returncode, done.stderr.count(b"\n")) == (1, 1)
    assert said in done.stderr.decode()


@pytest.mark.parametrize(("module", "words"), [("textwrap", "--help"), ("cyclopts", "status")])
def test_ctrl_c_during_imports_shows_no_traceback(tmp_path: Path, module: str, words: str) -> None:
    (tmp_path / f"{module}.py").write_text("raise KeyboardInterrupt\n")
    done = run(f"$B {words}", tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")
