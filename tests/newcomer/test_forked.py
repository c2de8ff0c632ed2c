"""The tests in several processes: what the run says of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
FILES = {
    "test_ends.py": "import os\ndef test_before(): pass\ndef test_ends(): os._exit(3)\ndef test_after(): pass\n",
    "test_fails.py": "def test_fails():\n    print('heard', 6 * 7)\n    assert False\n",
    "test_passes.py": "def test_passes(tmp_path):\n    assert not list(tmp_path.iterdir())\n",
    "test_skips.py": "import pytest\ndef test_skips(): pytest.skip('no moon')\n",
}


def test_each_test_is_told_once_and_one_that_ends_its_process_costs_its_file_alone(tmp_path: Path) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    command = [sys.executable, "-m", "pytest", "-p", "forked", "--forks", "2", "-rs", "-p", "no:cacheprovider"]
    paths = {"PYTHONPATH": str(TESTS), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [*command, "--rootdir", tmp_path, tmp_path],
        cwd=tmp_path,
        env=paths,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    assert "3 failed, 2 passed, 1 skipped" in done.stdout
    assert "its process ended with exit code 3" in done.stdout
    assert "not run: its process was ended by a test before it" in done.stdout
    assert "heard 42" in done.stdout
    assert "no moon" in done.stdout
