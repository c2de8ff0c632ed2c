"""The distribution is what it says."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


@pytest.mark.parametrize("package", PACKAGES)
def test_each_top_level_name_is_ours_alone(package: str) -> None:
    assert set(packages_distributions().get(package, ["bodyschema"])) == {"bodyschema"}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_package_has_the_name_of_a_standard_module(package: str) -> None:
    assert package not in sys.stdlib_module_names


def test_the_lock_file_names_no_download_host() -> None:
    assert not re.search(r"https?://|--(extra-)?index-url", (ROOT / "requirements.lock").read_text(encoding="utf-8"))


def test_every_dependency_is_justified() -> None:
    decision = (ROOT / "docs/decisions/0001-dependencies.md").read_text(encoding="utf-8")
    extras = PROJECT["project"]["optional-dependencies"].values()
    wanted = [*PROJECT["project"]["dependencies"], *(name for extra in extras for name in extra)]
    names = [re.split(r"[\[<>=;~ ]", requirement)[0] for requirement in wanted]
    assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", decision)] == []


FOREIGN = ("msgspec", "cv2", "zenoh", "interfaces", "logging.handlers")
HEAVY = ("pybullet", "matplotlib", "cv2", "scipy", "numpy", "zenoh")


def test_help_imports_nothing_heavy() -> None:
    code = f"""
import sys
from daemon.cli import app
try:
    app(["--help"])
except SystemExit:
    pass
print("heavy:", [name for name in {HEAVY} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "heavy: []" in result.stdout


def test_the_maths_imports_numpy_and_scipy_alone() -> None:
    code = f"""
import sys
import kbmaps
print("foreign:", [name for name in {FOREIGN} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "foreign: []" in result.stdout
