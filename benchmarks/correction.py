"""CPU time of the readers of correction.json for one reading of a 6-joint arm with 5 effects, best of 7.

    python -m benchmarks.correction

Measured without compliant joints, and with two, for which the load is computed three times a reading. Needs g++ for C++
and node for JavaScript; missing ones are skipped.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from bodyschema.effects import Effect, Simulation
from bodyschema.effects.exports import write_correction
from bodyschema.robot.description import RobotDescription

READERS = Path(__file__).resolve().parents[1] / "examples" / "correction"
JOINTS = tuple(f"q{k}" for k in range(1, 7))
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
RIGID = (
    ("joint_offset", "q2", None, [0.02]),
    ("joint_scale", "q3", None, [0.01]),
    ("joint_eccentricity", "q1", None, [0.01, 0.004]),
    ("joint_coupling", "q5", "q4", [0.02]),
    ("backlash", "q4", None, [0.01]),
)
ELASTIC = (*RIGID[1:4], ("joint_compliance", "q2", None, [0.001]), ("joint_compliance", "q3", None, [0.001]))
READINGS, REPEATS = 20_000, 7
TOML = """[robot]
name = "six"
urdf = "six.urdf"
joints = [{joints}]
marker_link = "link6"
marker_xyz = [0.05, 0.0, 0.1]
hold = "held"
[camera]
parent_link = "link0"
xyz = [1.5, 0.2, 0.8]
"""
IN_PYTHON = """
import sys, time
sys.path.insert(0, {readers!r})
from correction import Correction
arm = Correction(open(sys.argv[1]).read())
rows = [list(map(float, line.split())) for line in open(sys.argv[2])]
for _ in range({repeats}):
    began = time.process_time()
    for q in rows:
        arm.read(q)
    print((time.process_time() - began) / len(rows))
"""
IN_JAVASCRIPT = """
const fs = require("fs"), { Correction } = require(READERS + "/correction.js");
const arm = new Correction(fs.readFileSync(process.argv[2], "utf8"));
const rows = fs.readFileSync(process.argv[3], "utf8").trim().split("\\n").map((line) => line.split(" ").map(Number));
for (let k = 0; k < REPEATS; k++) {
  const began = process.cpuUsage();
  for (const q of rows) arm.read(q);
  console.log(process.cpuUsage(began).user / 1e6 / rows.length);
}
"""
IN_CPP = """
#include "correction.hpp"
#include <cstdio>
#include <ctime>
#include <fstream>
#include <iterator>
int main(int, char** argv) {
  std::ifstream file(argv[1]), numbers(argv[2]);
  Correction arm(std::string(std::istreambuf_iterator<char>(file), {}));
  std::vector<double> all(std::istream_iterator<double>(numbers), {});
  std::vector<std::vector<double>> rows;
  for (size_t k = 0; k < all.size(); k += 6) rows.emplace_back(all.begin() + k, all.begin() + k + 6);
  for (int repeat = 0; repeat < REPEATS; ++repeat) {
    const auto began = std::clock();
    for (const auto& q : rows) arm.read(q);
    std::printf("%.12g\\n", double(std::clock() - began) / CLOCKS_PER_SEC / rows.size());
  }
}
"""


def six_joints(folder: Path) -> RobotDescription:
    """Write and load an arm of six links of 0.2 m and 2 kg."""
    inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
    mass = f'<inertial><origin xyz="0 0 0.1"/><mass value="2"/>{inertia}</inertial>'
    links = "".join(f'<link name="link{k}">{mass}</link>' for k in range(7))
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
        f'<origin xyz="0 0 0.2"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
        for k, (name, axis) in enumerate(zip(JOINTS, AXES, strict=True))
    )
    (folder / "six.urdf").write_text(f'<robot name="six">{links}{joints}</robot>')
    (folder / "robot.toml").write_text(TOML.format(joints=", ".join(f'"{name}"' for name in JOINTS)))
    return RobotDescription.load(folder / "robot.toml")


def commands(folder: Path) -> dict[str, list[str]]:
    """Return the command that runs each reader's loop."""
    (folder / "loop.py").write_text(IN_PYTHON.format(readers=str(READERS), repeats=REPEATS))
    found = {"Python": [sys.executable, str(folder / "loop.py")]}
    if node := shutil.which("node"):
        text = IN_JAVASCRIPT.replace("READERS", repr(str(READERS))).replace("REPEATS", str(REPEATS))
        (folder / "loop.js").write_text(text)
        found["JavaScript"] = [node, str(folder / "loop.js")]
    if compiler := shutil.which("g++"):
        (folder / "loop.cpp").write_text(IN_CPP.replace("REPEATS", str(REPEATS)))
        built = str(folder / "loop")
        subprocess.run([compiler, "-std=c++17", "-O2", f"-I{READERS}", f"{built}.cpp", "-o", built], check=True)
        found["C++"] = [built]
    return found


def main() -> None:
    """Print a table of the times of one reading."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = six_joints(folder)
        q = np.cumsum(np.random.default_rng(0).normal(0.0, 0.01, (READINGS, len(JOINTS))), axis=0)
        np.savetxt(folder / "rows.txt", np.clip(q, -2.0, 2.0))
        loops = commands(folder)
        print("| reader | 5 effects | 5 effects, 2 of them compliance |\n| --- | ---: | ---: |")
        files = []
        for which, effects in (("rigid", RIGID), ("elastic", ELASTIC)):
            simulation = Simulation(robot, tuple(Effect.at(robot, *effect) for effect in effects))
            files.append(folder / f"{which}.json")
            write_correction(simulation, files[-1], "a benchmark")
        for language, command in loops.items():
            times = []
            for file in files:
                run = [*command, str(file), str(folder / "rows.txt")]
                told = subprocess.run(run, capture_output=True, text=True, check=True).stdout
                times.append(1e6 * min(map(float, told.split())))
            print(f"| {language} | {times[0]:.2f} µs | {times[1]:.2f} µs |")


if __name__ == "__main__":
    main()
