"""Forked processes of `warm`: their error output comes as that of an interpreter of their own."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import warm

KILLED = """
import os, signal, sys
print("said", file=sys.stderr)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(
    ("program", "code"),
    [(KILLED, -signal.SIGKILL), ("import sys\nsys.exit('said')", 1), ("import sys\nsys.stderr.write('said')", 0)],
    ids=["killed", "exit with a message", "no line end"],
)
def test_error_output_survives_every_kind_of_exit(tmp_path: Path, program: str, code: int) -> None:
    (tmp_path / "program.py").write_text(program)
    ended = warm.run(tmp_path / "program.py")
    assert (ended.returncode, ended.stderr.strip()) == (code, "said")


def test_unencodable_error_output_is_escaped(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text("import sys\nprint('\\udcff', file=sys.stderr)")
    assert warm.run(tmp_path / "program.py").stderr == "\\udcff\n"
