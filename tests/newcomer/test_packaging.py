"""The distribution matches its metadata."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import kbmaps

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


distributions = functools.cache(packages_distributions)  # takes a second


@pytest.mark.parametrize("package", PACKAGES)
def test_each_top_level_name_is_ours_alone(package: str) -> None:
    assert set(distributions().get(package, ["bodyschema"])) == {"bodyschema"}


@pytest.mark.parametrize("package", PACKAGES)
def test_no_package_shadows_standard_module(package: str) -> None:
    assert package not in sys.stdlib_module_names


@pytest.mark.parametrize("file", ["requirements.lock", "requirements-demo.lock"])
def test_the_lock_file_names_no_download_host(file: str) -> None:
    assert not re.search(r"https?://|--(extra-)?index-url", (ROOT / file).read_text(encoding="utf-8"))


def test_every_dependency_is_justified() -> None:
    decision = (ROOT / "docs/decisions/0001-dependencies.md").read_text(encoding="utf-8")
    extras = PROJECT["project"]["optional-dependencies"].values()
    wanted = [*PROJECT["project"]["dependencies"], *(name for extra in extras for name in extra)]
    names = [re.split(r"[\[<>=;~ ]", requirement)[0] for requirement in wanted]
    assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", decision)] == []


FOREIGN = ("msgspec", "cv2", "zenoh", "bodyschema", "logging.handlers")


def test_a_client_imports_neither_scipy_nor_opencv() -> None:
    """`status` and `predict` take a fraction of a second of CPU; scipy alone takes one."""
    robot = ROOT / "examples/desk_arm/robot.toml"
    code = f"""
import sys
from pathlib import Path
from bodyschema.daemon.transport import session
from bodyschema.cli.terminal import status_view
from bodyschema.cli.commands.run import predict, status
from bodyschema.calibration.plausibility import limits
from bodyschema.daemon.config import Config
assert Config.load(Path({str(robot)!r})).robot.chain.joints == 4
print("heavy:", [name for name in ("scipy", "cv2", "pybullet", "matplotlib") if f"{{name}}.version" in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert result.stdout == "heavy: []\n"


def test_type_checkers_see_what_kbmaps_imports_lazily() -> None:
    tree = ast.parse(Path(kbmaps.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    checked = {
        alias.name: getattr(import_module(node.module), alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("kbmaps.")
        for alias in node.names
    }
    assert checked == {name: getattr(kbmaps, name) for name in kbmaps.__all__}


def test_demo_lock_file_is_subset() -> None:
    whole, demo = (
        set(re.findall(r"^[a-z][^ ]*==[^ ]*", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE))
        for file in ("requirements.lock", "requirements-demo.lock")
    )
    assert demo
    assert demo <= whole


def test_the_maths_imports_numpy_and_scipy_alone() -> None:
    code = f"""
import sys
import kbmaps
print("foreign:", [name for name in {FOREIGN} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert "foreign: []" in result.stdout
