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
# Numbers that nobody tuned: register tables, wire and file formats, in the modules that hold nothing else.
TABLES = (
    "drivers/dynamixel/emulator/factory.py",
    "drivers/dynamixel/emulator/frames.py",
    "drivers/dynamixel/emulator/servo.py",
    "drivers/dynamixel/crc16.py",
    "drivers/dynamixel/models.py",
    "drivers/dynamixel/packets.py",
    "drivers/feetech/emulator/servo.py",
    "drivers/feetech/models.py",
    "drivers/markers/natnet/packets.py",
    "drivers/ros2/cdr.py",
    "drivers/ros2/messages.py",
    "drivers/ros2/rmw.py",
    "drivers/serial_lines/lines.py",
    "recordings/store/schema.py",
    "robot/lerobot.py",
    "vision/tags/dictionary.py",
)
# And elsewhere: versions of formats, units, bytes of a protocol, constants of mathematics and of a distribution.
FACTS = re.compile(
    r"_?(SCHEMA|VERSION\w*|NANO|DEG|BITS_PER_BYTE|\w*BAUDS?2?|BROADCAST|\w*_ID|EYE|ZERO|NONE|NO_TURN|UNTURNED|IDENTITY|"
    r"NORMAL_95|HALF_WIDTH_95|CHI2\w*|GOLDEN|MEAN_LENGTH|MEAN_OVER_RMS|MEDIAN_COSTS|DECADE|\w*_PER_UNIT|\w*_UNIT_S|"
    r"POLYNOMIAL|STATUS|ALERT|TERMIOS2|LINE_SPEED|SO_\w+|PR_\w+|\w*_MODE|TURN_TICKS|CHECKSUM_BYTES|CHUNK)"
)
# Constants of a distribution, counts of coordinates, index patterns, stencils, units, codes of the system, colours.
MORE_FACTS = re.compile(
    r"MEDIAN_NORM|_ONE_SIGMA|ENTRY_OF_TURN|MEDIAN_TO_SIGMA|_RADIUS_95|UNKNOWN_TURN_RAD2|_THIRD_OF_A_TURN|QUARTER|_?FORWARD|"
    r"POSITION_OUTPUTS|POSE_OUTPUTS|_ALLOWED_OUTPUTS|CORE_NUMBERS|_MOTIONS|_(FIXED|JOINT)_PARAMETERS|_CONSTANTS|_HARMONICS|"
    r"_ROWS, _COLUMNS|_FIRST, _SECOND|_FACTORS|_STENCIL|_SLOPES|_FLIP|_MM|_UNITS|_?UNITS_PER_(METRE|SECOND)|"
    r"TIME_ERROR|TIMEX_BYTES|TCGETS2, TERMIOS2|_PRIORITIES|WITH_RESTART_STEPS|_LARGEST_(COUNT|SEQ)|FIRST_ROW_LINE|"
    r"_JOINTS, _MARKER|_GREY, _ORANGE|_STL_\w+|ERRORS|_HOMING_SIGN|PROTOCOL1, PROTOCOL2|HEADER, LARGEST_ID"
)
# In rooms that move data and compute no estimate: bounds against broken input, and how long loops and requests wait.
OF_IO = ("cli", "daemon", "dashboard", "drivers", "fleet", "interfaces", "recordings", "robot", "sim_backend")
BOUNDS = re.compile(r"(MOST|LARGEST|LONGEST|FARTHEST|SMALLEST|OLDEST|NEWEST|HEAVIEST|KEPT|SENDERS|NAMES|REMEMBERED)")
WAITS = re.compile(
    r"_?(\w*(EVERY|LIMIT|TIMEOUT|RETRY|READ|WAIT|PERIOD|TICK|IDLE|GLANCE|ANSWER|ASK|REST|CHECK|AFTER|END|POLL|LOOK|"
    r"CONNECT|OPEN|LEASE|HEARTBEAT)\w*_M?S|NICENESS|ATTEMPTS|\w*PORT)$"
)
# Catalogues: one file an effect, which a new effect joins without another change.
ONE_FILE_AN_EFFECT = ("diagnosis/report/presenters", "effects/catalogue")
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


def kind_of_number(file: Path, name: str) -> str:
    """Classify a module-level number as "fact", "bound" or "wait"; all others are "tuned"."""
    if str(file) in TABLES or FACTS.fullmatch(name.split(",")[0]) or MORE_FACTS.fullmatch(name):
        return "fact"
    if file.parts[0] in OF_IO:
        if BOUNDS.match(name):
            return "bound"
        if WAITS.match(name.split(",")[0]):
            return "wait"
    return "tuned"


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
    kinds = Counter(kind_of_number(file, name) for file, tree in trees.items() for name in numbers(tree))
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "results").glob("*.md")]
    users = [page for page in pages if page.name != "maths.md" and page.parent.name != "results"]
    return {
        "largest folder": f"{largest[0]}, {largest[1] / total:.0%}",
        "modules flat in one folder": f"{biggest[1]} in {biggest[0]}/",
        "... where not one file an effect": f"{crowded[1]} in {crowded[0]}/",
        "import exceptions": sum(len(contract.get("ignore_imports", ())) for contract in contracts),
        "product lines": total,
        f"modules of up to {SMALL} lines with one importer": small_with_one_importer(files),
        "numbers at the top of modules": kinds.total(),
        "of these: facts of hardware, formats and mathematics": kinds["fact"],
        "of these: bounds against broken input": kinds["bound"],
        "of these: waits of loops and requests": kinds["wait"],
        "of these: tuned": kinds["tuned"],
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
