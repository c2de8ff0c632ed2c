"""The readers of correction.json agree with the simulation, and with each other."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from effect_arms import arm, everywhere, sized, walk

from bodyschema.effects import EFFECT_TYPES, Effect, LiveEncoders, Motion, Simulation
from bodyschema.effects.exports import write_correction
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription

READERS = Path(__file__).resolve().parents[2] / "examples" / "correction"
OPTICAL = {"camera_scale", "camera_focal", "camera_refocused", "lens_distortion"}
NOT_OF_THE_ARM = {*OPTICAL, "camera_latency", "thermal_drift"}
# The program in C++, in a locale whose numbers have decimal commas.
WITH_DECIMAL_COMMAS = """
#include "READERS/correct.cpp"
struct Commas : std::numpunct<char> {
  char do_decimal_point() const override { return ','; }
};
static const auto before = std::locale::global(std::locale(std::locale(), new Commas));
"""
# What one of the languages would read as a number or as a space, and words that none would.
WRONG_WORDS = (
    *("0.1x", "word", "1,,x", "0x10", "-0X1p3", "0x", "0b1", "0o7", "1_0", "1e", "1e+", "1e2.5", "1d3", "1f", "nan(1)"),
    *("\u0661", "\u22121", "\u00bd", ".", "-", "+", "--1", "+-1", "1.2.3", "infinit", "null", "true", "[1]", "'1'"),
    *("\ufeff1", "1\u00a0", "1\u2003", "1\x1c", "1\0", "\0", "\xa0", "1;"),
)
# The main program of a reader for each line alone, in one process.
EACH_LINE = {
    "python": """
import io, json, runpy, sys
for line in json.load(sys.stdin):
    sys.stdin = io.StringIO(line)
    try:
        runpy.run_path(sys.argv[1], run_name="__main__")
    except ValueError:
        print("refused")
""",
    "javascript": """
const fs = require("fs"), read = fs.readFileSync, { _load, _cache } = require("module"), reader = process.argv[1];
for (const line of JSON.parse(read(0, "utf8"))) {
  fs.readFileSync = (file, ...more) => (file === 0 ? line : read(file, ...more));
  try { delete _cache[reader]; _load(reader, null, true); } catch { console.log("refused"); }
}
""",
}
NAMES = tuple(name for name in EFFECT_TYPES if name not in NOT_OF_THE_ARM)


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the command of each reader that this machine can run."""
    found = {"python": [sys.executable, str(READERS / "correction.py")]}
    if node := shutil.which("node"):
        found["javascript"] = [node, str(READERS / "correction.js")]
    if compiler := shutil.which("g++"):
        built = str(tmp_path_factory.mktemp("built") / "correct")
        program = Path(built + ".cpp")
        program.write_text(WITH_DECIMAL_COMMAS.replace("READERS", str(READERS)))
        warnings = ["-Wall", "-Wextra", "-Werror"]
        subprocess.run([compiler, "-std=c++17", *warnings, str(program), "-o", built], check=True)
        found["c++"] = [built]
    return found


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotDescription:
    return arm(tmp_path_factory.mktemp("arm"))


def steady(rows: int = 40) -> Motion:
    """Return a walk in one run, whose rows come at the usual interval."""
    return Motion(walk(rows=rows).q, 0.1 * np.arange(rows), np.zeros(rows, dtype=np.int64))


def read_lines(command: list[str], file: Path, lines: str) -> subprocess.CompletedProcess[str]:
    """Run a reader that may fail."""
    return subprocess.run([*command, str(file)], input=lines, capture_output=True, text=True, check=False)


def corrected(command: list[str], file: Path, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return true joint angles (n, d) and positions (n, 3) computed by a reader."""
    lines = "\n".join(" ".join(map(repr, row)) for row in q.tolist())
    run = subprocess.run([*command, str(file)], input=lines, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in run.stdout.splitlines()], dtype=np.float64)
    return found[:, : q.shape[1]], found[:, q.shape[1] :].reshape(-1, 3, 4)[:, :, 3]


def began(effect: Effect) -> Effect:
    """Return the effect with its moment before the first row."""
    return effect.with_values(np.append(effect.values[:-1], -1.0)) if effect.kind.begins else effect


def correction(file: Path) -> Any:
    """Return the reader in Python, as an import."""
    sys.path.insert(0, str(READERS))
    try:
        return import_module("correction").Correction(file.read_text())
    finally:
        sys.path.remove(str(READERS))


@pytest.mark.parametrize("name", NAMES)
def test_python_agrees_effect_by_effect(name, robot, tmp_path) -> None:
    motion = steady()
    for place in [where for where in everywhere(robot) if where[0] == name]:
        simulation = Simulation(robot, (began(sized(robot, place, 1.0)),))
        assert not [told for told in write_correction(simulation, tmp_path / "c.json", "") if told.startswith("not")]
        reader = correction(tmp_path / "c.json")
        found = [reader.read(row.tolist()) for row in motion.q]
        run = simulation.run(motion)
        # The side on which a backlash starts is known once the joint has moved.
        np.testing.assert_allclose([angles for angles, _ in found][1:], run.q[1:], rtol=0, atol=1e-12)
        np.testing.assert_allclose([pose[3::4] for _, pose in found][1:], run.measured[1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("language", ["python", "c++", "javascript"])
def test_all_effects_together_agree(language, commands, robot, tmp_path) -> None:
    if language not in commands:
        pytest.skip(f"no compiler or interpreter of {language}; to run it: apt install g++ nodejs")
    effects = [began(sized(robot, where, 0.3, k)) for k, where in enumerate(everywhere(robot)) if where[0] in NAMES]
    # A spring is loaded by the moved links here, and by those of the URDF in the simulation.
    simulation = Simulation(robot, tuple(effect for effect in effects if effect.name != "link_geometry"))
    write_correction(simulation, tmp_path / "c.json", "")
    motion, file = steady(), tmp_path / "c.json"
    angles, x = corrected(commands[language], file, motion.q)
    run = simulation.run(motion)
    np.testing.assert_allclose(angles[1:], run.q[1:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(x[1:], run.measured[1:], rtol=0, atol=1e-9)


def test_the_three_readers_agree_exactly_with_geometry(commands, robot, tmp_path) -> None:
    effects = [began(sized(robot, where, 0.3, k)) for k, where in enumerate(everywhere(robot)) if where[0] in NAMES]
    write_correction(Simulation(robot, tuple(effects)), tmp_path / "c.json", "")
    found = {language: corrected(command, tmp_path / "c.json", steady().q) for language, command in commands.items()}
    for angles, x in found.values():
        np.testing.assert_allclose(angles, found["python"][0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(x, found["python"][1], rtol=0, atol=1e-13)


def test_backlash_starts_as_in_the_simulated_world(commands, robot, tmp_path) -> None:
    simulation = Simulation(robot, tuple(Effect.at(robot, "backlash", joint, values=[0.02]) for joint in robot.joints))
    write_correction(simulation, tmp_path / "c.json", "")
    q, live = np.repeat(steady(10).q, 3, axis=0), LiveEncoders(simulation)
    wanted = [live.true_angles(row, 0.0, np.zeros_like(row)) for row in q]
    for command in commands.values():
        np.testing.assert_allclose(corrected(command, tmp_path / "c.json", q)[0], wanted, rtol=0, atol=1e-14)


def test_friction_keeps_a_loose_joint_on_its_side(commands, robot, tmp_path) -> None:
    motion, k = steady(), robot.joints.index("rail")
    simulation = Simulation(robot, (Effect.at(robot, "gravity_backlash", "rail", values=[0.002, 2.0]),))
    wanted = simulation.run(motion).q
    kept = np.sign(wanted[:, k] - motion.q[:, k]) != np.sign(Simulation(robot).torques(motion.q)[:, k])
    assert 0 < kept.sum() < len(kept)
    write_correction(simulation, tmp_path / "c.json", "")
    for command in commands.values():
        np.testing.assert_allclose(corrected(command, tmp_path / "c.json", motion.q)[0], wanted, rtol=0, atol=1e-12)


def test_readers_resume_memory_from_state_in_file(commands, robot, tmp_path) -> None:
    pairs = [
        ("backlash", "elbow", [0.02]),
        ("settling", "wrist", [0.1, 0.5]),
        ("hysteresis", "rail", [0.001, 0.02]),
        ("gravity_backlash", "shoulder_lift", [0.02, 0.1]),
    ]
    simulation = Simulation(robot, tuple(Effect.at(robot, name, at, values=values) for name, at, values in pairs))
    file, q = tmp_path / "c.json", steady().q
    write_correction(simulation, file, "")
    contents = json.loads(file.read_text())
    whole = corrected(commands["python"], file, q)[0]
    reader = correction(file)
    for row in q[:20]:
        reader.read(row.tolist())
    contents["numbers"][: len(reader.registers)] = reader.registers
    file.write_text(json.dumps(contents))
    for command in commands.values():
        np.testing.assert_allclose(corrected(command, file, q[20:])[0], whole[20:], rtol=0, atol=1e-14)


def test_settling_with_one_move_memory_is_read_correctly(commands, robot, tmp_path) -> None:
    simulation = Simulation(robot, (Effect.at(robot, "settling", "wrist", values=[0.1, 0.0]),))
    write_correction(simulation, tmp_path / "c.json", "")
    motion = steady()
    for command in commands.values():
        angles, _ = corrected(command, tmp_path / "c.json", motion.q)
        np.testing.assert_allclose(angles[1:], simulation.run(motion).q[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", sorted(NOT_OF_THE_ARM))
def test_effects_outside_the_arm_are_listed_as_omitted(name, robot, tmp_path) -> None:
    simulation = Simulation(robot, (sized(robot, (name, None, None), 1.0),))
    [told] = write_correction(simulation, tmp_path / "c.json", "")
    assert told.startswith(f"not in the file: {name}")
    assert json.loads((tmp_path / "c.json").read_text())["notes"] == [told]


def test_older_file_version_error_names_export_command(commands, robot, tmp_path) -> None:
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    old = (tmp_path / "c.json").read_text().replace('correction 3"', 'correction", "version": 2')
    (tmp_path / "c.json").write_text(old)
    for command in commands.values():
        run = read_lines(command, tmp_path / "c.json", "")
        assert run.returncode != 0
        assert "bodyschema export" in run.stderr


@pytest.mark.parametrize(
    ("place", "wrong"),
    [
        ("joints", -1),
        ("joints", 1.5),
        ("joints", 10_000),
        ("registers", 2),
        ("registers", 10_000_000),
        ("step", 10),
        ("step", -1),
        ("to", -1),
        ("to", 1),
        ("to", 0.5),
        ("to", "registers"),
        ("to", None),
        ("to", [3]),
        ("to", float("nan")),
        ("to", "3"),
    ],
)
def test_cpp_reader_refuses_out_of_bounds_numbers(place, wrong, commands, robot, tmp_path) -> None:
    if "c++" not in commands:
        pytest.skip("no compiler of c++; to run it: apt install g++")
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    contents = json.loads((tmp_path / "c.json").read_text())
    registers = contents["numbers"][1]
    at = {"joints": 0, "registers": 1, "step": registers, "to": registers + 1}[place]
    contents["numbers"][at] = registers if wrong == "registers" else wrong
    (tmp_path / "c.json").write_text(json.dumps(contents))
    refused_in_cpp(commands, tmp_path / "c.json")


@pytest.mark.parametrize("numbers", [None, 0.0, [], [8.0], [[0.0]], "[8]"])
def test_cpp_reader_refuses_invalid_numbers_field(numbers, commands, robot, tmp_path) -> None:
    if "c++" not in commands:
        pytest.skip("no compiler of c++; to run it: apt install g++")
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    contents = json.loads((tmp_path / "c.json").read_text()) | {"numbers": numbers}
    (tmp_path / "c.json").write_text(json.dumps(contents))
    refused_in_cpp(commands, tmp_path / "c.json")


@pytest.mark.parametrize("missing", range(1, 5))
def test_cpp_reader_refuses_incomplete_steps(missing, commands, robot, tmp_path) -> None:
    if "c++" not in commands:
        pytest.skip("no compiler of c++; to run it: apt install g++")
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    contents = json.loads((tmp_path / "c.json").read_text())
    contents["numbers"] = contents["numbers"][:-missing]
    (tmp_path / "c.json").write_text(json.dumps(contents))
    refused_in_cpp(commands, tmp_path / "c.json")


def refused_in_cpp(commands: dict[str, list[str]], file: Path) -> None:
    run = read_lines(commands["c++"], file, "")
    assert run.returncode != 0
    assert "not a correction of version 3" in run.stderr


def test_a_file_that_ends_too_soon_is_refused(commands, robot, tmp_path) -> None:
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    (tmp_path / "c.json").write_text((tmp_path / "c.json").read_text()[:-20])
    for command in commands.values():
        run = read_lines(command, tmp_path / "c.json", "")
        assert run.returncode != 0
        assert run.stderr


def test_lines_are_read_alike(commands, robot, tmp_path) -> None:
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    d = len(robot.joints)
    for language, command in commands.items():
        for count in (d - 1, d + 1):
            run = read_lines(command, tmp_path / "c.json", " ".join(["0.1"] * count))
            assert run.returncode != 0, language
            assert "another number of readings than of joints" in run.stderr, language
        spaced, commas = " ".join(["0.1"] * d), ", ".join(["0.1"] * d)
        run = read_lines(command, tmp_path / "c.json", f"\n{spaced}\n  \n,\n{commas}\r\n\n")
        assert run.returncode == 0, language
        first, second = run.stdout.splitlines()
        assert first == second, language
        assert read_lines(command, tmp_path / "c.json", "\n").stdout == "", language
        accepted = ("-.5", "1.", "1E-2", "+2")
        run = read_lines(command, tmp_path / "c.json", "\n".join(" ".join([word] * d) for word in accepted))
        assert (run.returncode, len(run.stdout.splitlines())) == (0, len(accepted)), language
        assert "nan" not in run.stdout.lower(), language


@pytest.mark.parametrize("language", ["python", "c++", "javascript"])
def test_words_that_are_no_numbers_are_refused_alike(language, commands, robot, tmp_path) -> None:
    if language not in commands:
        pytest.skip(f"no compiler or interpreter of {language}; to run it: apt install g++ nodejs")
    write_correction(Simulation(robot), tmp_path / "c.json", "")
    lines = [" ".join([word, *["1"] * (len(robot.joints) - 1)]) for word in WRONG_WORDS]
    if language == "c++":  # starts at once
        answers = [read_lines(commands[language], tmp_path / "c.json", line) for line in lines]
        found = ["refused" if run.returncode and not run.stdout else run.stdout for run in answers]
    else:
        interpreter, reader = commands[language]
        flag = "-c" if language == "python" else "-e"
        program = EACH_LINE[language].replace("sys.argv[1]", repr(reader))
        arguments = [flag, program] if language == "python" else [flag, program, reader]
        found = read_lines([interpreter, *arguments], tmp_path / "c.json", json.dumps(lines)).stdout.splitlines()
    assert dict(zip(WRONG_WORDS, found, strict=True)) == dict.fromkeys(WRONG_WORDS, "refused")


def test_settling_is_skipped_when_every_reading_is_interrupted(robot, tmp_path) -> None:
    play, settling = Effect.at(robot, "backlash", "elbow", values=[0.02]), ("settling", "wrist", [0.1, 0.5])
    found = []
    for effects in ((play,), (play, Effect.at(robot, *settling[:2], values=settling[2]))):
        write_correction(Simulation(robot, effects), tmp_path / "c.json", "")
        reader = correction(tmp_path / "c.json")
        found.append([reader.read(row.tolist(), pace=None)[0] for row in steady(12).q])
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, pytest.param(-np.inf, marks=pytest.mark.soak)])
def test_non_finite_reading_leaves_memory_unchanged(wrong, commands, robot, tmp_path) -> None:
    pairs = [
        ("backlash", "elbow", [0.02]),
        ("settling", "wrist", [0.1, 0.5]),
        ("hysteresis", "rail", [0.001, 0.02]),
        ("gravity_backlash", "shoulder_lift", [0.02, 0.1]),
        ("joint_eccentricity", "elbow", [0.01, 0.004]),
    ]
    simulation = Simulation(robot, tuple(Effect.at(robot, name, at, values=values) for name, at, values in pairs))
    file, q = tmp_path / "c.json", steady(12).q
    write_correction(simulation, file, "")
    bad = np.insert(q, [0, 6], wrong, axis=0)  # all joints, before the first row and in between
    for command in commands.values():
        (angles, x), (found, at) = corrected(command, file, q), corrected(command, file, bad)
        kept = np.isfinite(bad).all(axis=1)
        assert np.isnan(found[~kept]).all()
        assert np.isnan(at[~kept]).all()
        np.testing.assert_array_equal(found[kept], angles)
        np.testing.assert_array_equal(at[kept], x)


def test_non_finite_reading_of_one_joint_spares_others(commands, robot, tmp_path) -> None:
    names = ("joint_scale", "backlash", "hysteresis")
    effects = [began(sized(robot, where, 0.3, k)) for k, where in enumerate(everywhere(robot)) if where[0] in names]
    write_correction(Simulation(robot, tuple(effects)), tmp_path / "c.json", "")
    q = steady(12).q
    q[[0, 5], 2] = np.nan
    found = {language: corrected(command, tmp_path / "c.json", q)[0] for language, command in commands.items()}
    for angles in found.values():
        assert (np.isnan(angles) == np.isnan(q)).all()
        np.testing.assert_allclose(angles, found["python"], rtol=0, atol=1e-13)


def test_the_readers_are_short(commands) -> None:
    """Check the lengths that docs/exporting.md states."""
    lengths = {}
    for name, comment in (("correction.py", "#"), ("correction.js", "//"), ("correction.hpp", "//")):
        text = re.sub(r'"""[\s\S]*?"""', "", (READERS / name).read_text())
        lengths[name] = sum(bool(line.strip()) and not line.strip().startswith(comment) for line in text.splitlines())
        assert all(len(line) <= 120 for line in text.splitlines())
    assert max(lengths.values()) <= 60
    assert max(map(len, (READERS / "correction.hpp").read_text().splitlines())) <= 100
