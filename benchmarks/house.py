"""Print how the source is laid out: sizes, imports, tuned numbers, words, commands, keys.

python -m benchmarks.house [--json]
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
NOT_PRODUCT = ("tests", "benchmarks", "docs", "examples")
SMALL = 80
# Catalogues: one file an effect, which a new effect joins without another change.
ONE_FILE_AN_EFFECT = ("diagnosis/report/presenters", "effects/catalogue")
SETTINGS = re.compile(r"(Settings|Limits|Waits|Layout)$")
QUESTIONS = re.compile(r"(Whether|What|How|Who)\b")


def product() -> list[Path]:
    """Return the product's modules, relative to the repository."""
    names = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    files = [Path(name) for name in names.split()]
    return [
        file for file in files if len(file.parts) > 1 and file.parts[0] not in NOT_PRODUCT and not _is_link(ROOT / file)
    ]


def numbers(tree: ast.Module) -> list[str]:
    """Return the module-level names that are assigned a value containing a number, type aliases excluded."""
    return [
        ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target).strip("()")
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and not _is_type(node.value)
        if any(isinstance(leaf, ast.Constant) and type(leaf.value) in (int, float) for leaf in ast.walk(node.value))
    ]


def settings(tree: ast.Module) -> int:
    """Count the numbers that are settings of an algorithm: fields of classes such as `_Settings` and `PairLimits`."""
    groups = [node for node in tree.body if isinstance(node, ast.ClassDef) and SETTINGS.search(node.name)]
    return sum(len(numbers(ast.Module(group.body, []))) for group in groups)


def docstrings(tree: ast.Module) -> Iterator[str]:
    """Yield all docstrings of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield text


def small_with_one_importer(files: list[Path]) -> int:
    """Return the number of modules of at most `SMALL` lines that a single module imports."""
    graph = grimp.build_graph("bodyschema", "kbmaps", cache_dir=None)
    found = 0
    for file in files:
        name = ".".join(file.with_suffix("").parts)
        module = name if name.startswith(("kbmaps", "bodyschema")) else f"bodyschema.{name}"
        if file.name == "__init__.py" or module not in graph.modules or _lines(file) > SMALL:
            continue
        found += len(graph.find_modules_that_directly_import(module)) == 1
    return found


def leaves() -> int:
    """Return the number of commands of the command line, groups excluded."""
    from bodyschema.cli.main import app

    def of(command: object) -> int:
        names = [name for name in command if not name.startswith("-")]  # type: ignore[attr-defined]
        own = not names or command.default_command is not None  # type: ignore[attr-defined]
        return own + sum(of(command[name]) for name in names)  # type: ignore[index]

    return of(app)


def keys() -> int:
    """Return the number of keys of robot.toml on its page; variants of one table share theirs."""
    table, found = "", set[tuple[str, str]]()
    for line in (ROOT / "docs" / "reference" / "robot_toml.md").read_text("utf-8").splitlines():
        if line.startswith("## "):
            table = line.partition(" of kind ")[0]
        elif line.startswith("| `"):
            found |= {(table, key) for key in re.findall(r"`(\w+)`", line.split("|")[1])}
    return len(found)


def measures() -> dict[str, float | str]:
    """Return each measure by its name."""
    files = product()
    trees = {file: ast.parse((ROOT / file).read_text("utf-8")) for file in files}
    lines = {file: _lines(file) for file in files}
    rooms, flat = Counter[str](), Counter[str]()
    for file, count in lines.items():
        rooms[file.parts[0]] += count
        flat[str(file.parent)] += file.name != "__init__.py"
    texts = [text for tree in trees.values() for text in docstrings(tree)]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    largest, biggest = rooms.most_common(1)[0], flat.most_common(1)[0]
    crowded = next(found for found in flat.most_common() if found[0] not in ONE_FILE_AN_EFFECT)
    total = sum(lines.values())
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "results").glob("*.md")]
    users = [page for page in pages if page.name != "maths.md" and page.parent.name != "results"]
    return {
        "largest folder": f"{largest[0]}, {largest[1] / total:.0%}",
        "modules flat in one folder": f"{biggest[1]} in {biggest[0]}/",
        "... where not one file an effect": f"{crowded[1]} in {crowded[0]}/",
        "import exceptions": sum(len(contract.get("ignore_imports", ())) for contract in contracts),
        "product lines": total,
        f"modules of up to {SMALL} lines with one importer": small_with_one_importer(files),
        "numbers at the top of modules": sum(len(numbers(tree)) for tree in trees.values()),
        "numbers in the settings of algorithms": sum(settings(tree) for tree in trees.values()),
        "docstrings that begin with a question": f"{_questions(texts):.1%}",
        "words in README": _words(ROOT / "README.md"),
        "words in the users' docs": sum(_words(page) for page in users),
        "words in pages of results": sum(_words(page) for page in pages if page.parent.name == "results"),
        "words in pages written from the source": sum(
            _words(page) for page in (ROOT / "docs" / "reference").glob("*.md")
        ),
        "commands": leaves(),
        "keys of robot.toml": keys(),
    }


def _questions(texts: list[str]) -> float:
    return sum(bool(QUESTIONS.match(text)) for text in texts) / len(texts)


def _lines(file: Path) -> int:
    return len((ROOT / file).read_text("utf-8").splitlines())


def _words(file: Path) -> int:
    return len(file.read_text("utf-8").split())


def _is_link(file: Path) -> bool:
    return any(part.is_symlink() for part in (file, *file.parents))


def _is_type(value: ast.expr) -> bool:
    return isinstance(value, ast.Subscript)


def main() -> None:
    """Print the measures as a table, or as JSON."""
    found = measures()
    if "--json" in sys.argv[1:]:
        print(json.dumps({"schema": 1, **found}, indent=2))
        return
    for name, value in found.items():
        print(f"{name:<54} {value:,}" if isinstance(value, int) else f"{name:<54} {value}")


if __name__ == "__main__":
    main()
