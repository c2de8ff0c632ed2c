"""Installing works with a C compiler and without one."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SAY = "import kbmaps; print(kbmaps.__file__, kbmaps.kernels_in_use(), kbmaps.JointBasis.trigonometric().size)"


@dataclass(frozen=True)
class Built:
    """A wheel's file name, the build's output, and the output of an interpreter that imports it."""

    wheel: str
    log: str
    says: list[str]


def built(folder: Path, **environment: str) -> Built:
    plain = {name: value for name, value in os.environ.items() if name not in ("BODYSCHEMA_PURE", "CC", "CFLAGS")}
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    result = subprocess.run(
        command, cwd=ROOT, env=plain | environment, capture_output=True, text=True, check=True, timeout=400
    )
    (wheel,) = folder.glob("*.whl")
    unpacked = folder / "unpacked"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    says = subprocess.run(
        [sys.executable, "-c", SAY],
        cwd=folder,
        env=plain | {"PYTHONPATH": str(unpacked)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert Path(says[0]).is_relative_to(unpacked)
    return Built(wheel.name, result.stdout + result.stderr, says)


def test_build_without_compiler_explains_pure_wheel(tmp_path):
    failing = shutil.which("false")
    if failing is None:
        pytest.skip("no command `false`; to run it: apt-get install coreutils")
    result = built(tmp_path, CC=failing)
    assert result.wheel.endswith("-py3-none-any.whl")
    assert result.says[1:] == ["numpy", "3"]
    assert "no compiled kernels" in result.log
    assert f"{failing} failed" in result.log


@pytest.mark.soak
def test_missing_compiler_does_not_stop_build(tmp_path):
    result = built(tmp_path, CC="no-such-compiler")
    assert result.wheel.endswith("-py3-none-any.whl")
    assert "no-such-compiler" in result.log


@pytest.mark.soak
def test_a_pure_wheel_can_be_asked_for(tmp_path):
    result = built(tmp_path, BODYSCHEMA_PURE="1")
    assert result.wheel.endswith("-py3-none-any.whl")
    assert "kernels" not in result.log


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler; to run it: apt-get install gcc")
def test_compiled_wheel_serves_python_3_11_and_later(tmp_path):
    result = built(tmp_path, CC="cc", CFLAGS="-O0 -Wall -Wextra -Werror -Wno-cast-function-type")
    assert "-cp311-abi3-" in result.wheel
    assert result.says[1:] == ["compiled", "3"]
