"""Run the instructions of docs/security.md: its openssl commands, its tables, and the files of deploy/."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "security.md"
SEVERAL, TWO = ROOT / "deploy" / "several_machines", ROOT / "deploy" / "two_machines"
OPENSSL_S = 500.0


def blocks(language: str) -> list[str]:
    """Return the page's code blocks in a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def carried_out(folder: Path) -> Path:
    """Run the page's commands in `folder` and return it with the certificates."""
    script = "set -eu\n" + "\n".join(blocks("bash"))
    command = ["bash", "-c", script]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=OPENSSL_S, check=False)
    except FileNotFoundError:
        pytest.skip("no bash; to run it: apt-get install bash")
    if "openssl: command not found" in done.stderr:
        pytest.skip("no openssl; to run it: apt-get install openssl")
    assert done.returncode == 0, done.stderr
    assert "anna.pem: OK" in done.stdout
    return folder


def table(file: Path, **changed: str) -> str:
    """Return a file of deploy/ with some strings replaced: `new=old` replaces `old` by the keyword `new`."""
    text = file.read_text(encoding="utf-8")
    for new, old in changed.items():
        assert old in text
        text = text.replace(old, new)
    return text
