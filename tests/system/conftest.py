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
        pytest.skip("no C compiler with V4L2's headers, so cameras cannot be emulated below OpenCV")
    return found


@pytest.fixture(scope="session")
def disk_shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library that makes disks fail and clocks jump."""
    found = failing_disk.compiled(tmp_path_factory.mktemp("disk_shim"))
    if found is None:
        pytest.skip("no C compiler, so nothing can be put between a process and its disk")
    return found
