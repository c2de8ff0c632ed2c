"""Fixtures of the tests of whole processes."""

from __future__ import annotations

from pathlib import Path

import failing_disk
import pytest
import v4l2_cameras


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = v4l2_cameras.compiled(tmp_path_factory.mktemp("shim"))
    if found is None:
        pytest.skip("cameras are emulated in C; to run it: apt-get install gcc linux-libc-dev")
    return found


@pytest.fixture(scope="session")
def disk_shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the library that makes disks fail and clocks jump."""
    found = failing_disk.compiled(tmp_path_factory.mktemp("disk_shim"))
    if found is None:
        pytest.skip("a shim in C stands between a process and its disk; to run it: apt-get install gcc")
    return found
