"""Dask workers started in a folder whose files have the names of modules that they import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from hostile_folder import HostileFolder

LIMIT_S = 400.0
AT_WORK = """from bodyschema.fleet.diagnosing import workers
if __name__ == "__main__":
    with workers(None, 1, 1) as client:
        assert client.submit(len, [1]).result() == 1
"""


@pytest.mark.soak
def test_workers_execute_nothing_of_the_current_folder(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    here, script = tmp_path / "hostile", tmp_path / "at_work.py"
    here.mkdir()
    script.write_text(AT_WORK)
    hostile = HostileFolder(here)
    # Like the command `bodyschema`: without -P, and with a script in another folder.
    subprocess.run([sys.executable, str(script)], cwd=here, capture_output=True, timeout=LIMIT_S, check=True)
    assert hostile.executed == []
