"""Fixtures of the tests of whole processes."""

from __future__ import annotations

from pathlib import Path

import pytest
from v4l2_cameras import compiled


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = compiled(tmp_path_factory.mktemp("shim"))
    if found is None:
        pytest.skip("no C compiler with V4L2's headers, so cameras cannot be emulated below OpenCV")
    return found
