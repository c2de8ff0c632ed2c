"""The distribution installs two packages, `bodyschema` and `kbmaps`, and each module has one name."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = sorted(link.name for link in (ROOT / "bodyschema").iterdir() if link.is_dir() and link.name[0] != "_")
LIMIT_S = 300.0
LOAD_ALL = """
import sys, warnings
from collections import Counter
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
import bodyschema

root = Path(bodyschema.__file__).resolve().parents[1]
for module in walk_packages(bodyschema.__path__, "bodyschema.", onerror=lambda name: None):
    if not module.name.endswith("__main__"):
        try:
            import_module(module.name)
        except ImportError as error:  # of an extra that is not installed
            assert error.name and error.name.partition(".")[0] not in {"bodyschema", *PARTS}, error
places = [str(root / name) + "/" for name in ("bodyschema", "kbmaps", *PARTS)]
files = [str(Path(file).resolve()) for m in list(sys.modules.values()) if (file := getattr(m, "__file__", None))]
ours = Counter(file for file in files if file.startswith(tuple(places)))
print(len(ours), [file for file, names in ours.items() if names > 1])
"""


@pytest.mark.parametrize("part", PARTS)
def test_each_part_is_a_relative_link(part: str) -> None:
    assert (ROOT / "bodyschema" / part).readlink() in (Path("..", part), Path("..", "benchmarks", part))


@pytest.mark.soak
def test_no_file_is_loaded_under_two_names() -> None:
    code = f"PARTS = {PARTS}\n{LOAD_ALL}"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=ROOT
    )
    assert done.stderr == ""
    count, _, twice = done.stdout.strip().partition(" ")
    assert (int(count) > 300, twice) == (True, "[]")


BARE = re.compile(rf"^\s*(import|from)\s.*(?<![.\w])({'|'.join(PARTS)})\b", re.MULTILINE)


def bare_imports(text: str) -> Iterator[str]:
    if not BARE.search(text):  # to parse all files takes seconds
        return
    for node in ast.walk(ast.parse(text)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [str(node.module)]
        yield from (name for name in names if name.partition(".")[0] in PARTS)


def test_no_part_imports_by_a_bare_name() -> None:
    files = [file for part in PARTS for file in (ROOT / part).rglob("*.py")]
    assert {str(file): names for file in files if (names := list(bare_imports(file.read_text("utf-8"))))} == {}


def plug_in(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run it as a plug-in: the old names are allowed, and `folder` is where packages are."""
    allowed = f"import sys; sys.path.insert(0, {str(folder)!r})\nfrom bodyschema.interfaces import old_names\n"
    command = [sys.executable, "-P", "-c", f"{allowed}old_names.allow()\n{code}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=folder)


def test_old_import_name_gives_plugin_same_module(tmp_path: Path) -> None:
    code = (
        "from interfaces.errors import ConfigError\nimport bodyschema.interfaces.errors as errors, interfaces.errors\n"
        "print(ConfigError is errors.ConfigError, interfaces.errors is errors, errors.__spec__.name)"
    )
    done = plug_in(tmp_path, code)
    assert done.stdout == "True True bodyschema.interfaces.errors\n"
    assert (
        "FutureWarning: a plug-in imports interfaces.errors, which is bodyschema.interfaces.errors now" in done.stderr
    )


@pytest.mark.parametrize("old", ["vision.tracker", "bodyschema.vision.tracker"])
def test_a_plug_in_gets_a_moved_module(tmp_path: Path, old: str) -> None:
    done = plug_in(tmp_path, f"from {old} import StereoTracker\nprint(StereoTracker.__module__)")
    assert done.stdout == "bodyschema.vision.ball.tracker\n"
    assert f"FutureWarning: a plug-in imports {old}, which is bodyschema.vision.ball.tracker now" in done.stderr


def test_another_package_keeps_its_name(tmp_path: Path) -> None:
    (tmp_path / "vision").mkdir()
    (tmp_path / "vision" / "__init__.py").write_text("OWN = 1")
    done = plug_in(tmp_path, "import vision; print(vision.OWN)")
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_old_import_name_fails_without_plugin() -> None:
    code = "import sys, bodyschema.cli.main, bodyschema.effects\nfrom bodyschema.interfaces.old_names import OldNames\n"
    code += "print(any(isinstance(finder, OldNames) for finder in sys.meta_path))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_the_type_checker_is_given_each_part() -> None:
    """It does not follow links by itself."""
    given = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pyright"]["include"]
    assert {f"bodyschema/{part}" for part in PARTS} <= set(given)
