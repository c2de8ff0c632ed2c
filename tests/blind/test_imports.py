"""The hiding code shares no code with the code that finds effects."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parent
OURS = {"kbmaps", "bodyschema", "benchmarks"}
INSTRUMENT = {
    "rendered.py": {"bodyschema.interfaces.camera", "bodyschema.interfaces.records", "bodyschema.vision.ball.tracker"}
}  # it looks at images
JUDGE = {
    "judge.py",
    "judgement.py",
    "figures.py",
    "meaning.py",
    "oracle.py",
    "sealed.py",
    "dense.py",
    "dense_judge.py",
    "dense_positions.py",
    "mujoco_cases.py",
}  # they know both sides
GENERATOR = sorted(file for file in HERE.glob("*.py") if not file.name.startswith("test_") and file.name not in JUDGE)


def imported(file: Path) -> Iterator[str]:
    """Yield full names of the modules that a file imports, without those of its own folder."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield str(node.module)
        elif isinstance(node, ast.ImportFrom) and node.level > 1:
            yield "tests"


@pytest.mark.parametrize("file", GENERATOR, ids=lambda file: file.stem)
def test_generator_imports_no_product_code_except_the_tracker(file: Path) -> None:
    ours = {name for name in imported(file) if name.partition(".")[0] in OURS | {"tests", "importlib"}}
    assert ours <= INSTRUMENT.get(file.name, set())


@pytest.mark.parametrize("file", GENERATOR, ids=lambda file: file.stem)
def test_the_generator_imports_nothing_of_its_judge(file: Path) -> None:
    nodes = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)]
    near = {name for node in nodes if node.level == 1 for name in (node.module, *(a.name for a in node.names)) if name}
    assert near.isdisjoint(Path(name).stem for name in JUDGE)


def test_the_check_sees_imports_inside_functions(tmp_path: Path) -> None:
    file = tmp_path / "sly.py"
    file.write_text(
        "def late():\n    from bodyschema.effects.stages import backlash\n    return backlash\n", encoding="utf-8"
    )
    assert list(imported(file)) == ["bodyschema.effects.stages"]
