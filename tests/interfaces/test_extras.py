"""Commands that the messages about missing packages name."""

from __future__ import annotations

import sys
import tomllib
from collections import namedtuple
from pathlib import Path

import pytest

from bodyschema.interfaces import extras

Version = namedtuple("Version", "major minor")


@pytest.mark.parametrize(
    ("pip", "command"),
    [
        ("/venv/bin/pip", "pip install 'bodyschema[view]'"),
        ("/usr/bin/pip", "/venv/bin/python -m pip install 'bodyschema[view]'"),
        (None, "/venv/bin/python -m pip install 'bodyschema[view]'"),
    ],
)
def test_the_command_installs_into_this_environment(monkeypatch, pip: str | None, command: str) -> None:
    monkeypatch.setattr(sys, "executable", "/venv/bin/python")
    monkeypatch.setattr(extras.shutil, "which", lambda _: pip)
    assert extras.install_command("view") == command


@pytest.mark.parametrize("extra", [*extras.MODULES, "export", "rerun"])
def test_install_command_names_an_existing_extra_or_package(extra: str) -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = extras.install_command(extra).rpartition(" ")[2].strip("'")
    assert named.removeprefix("bodyschema[").removesuffix("]") in {
        *project["optional-dependencies"],
        "pyrealsense2",
        "av",
    }


@pytest.mark.parametrize(("minor", "remedy"), [(11, "bodyschema[sim]"), (13, "no wheel for 3.13")])
def test_missing_pybullet_wheel_yields_no_install_command(monkeypatch, minor: int, remedy: str) -> None:
    monkeypatch.setattr(sys, "version_info", Version(3, minor))
    error = extras.missing("pybullet", "sim", "the simulation")
    assert remedy in str(error)
    assert ("pip install" in str(error)) == (minor == 11)
