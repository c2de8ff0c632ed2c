"""Diagnoses of measured arms: `python -m benchmarks.diagnose_real --data FOLDER [--sets NAME ...] [--every N]`.

FOLDER holds a folder for each set, with robot.toml and measured.csv. Errors are those of held-out rows: held out in
blocks of adjacent rows, and row by row at random; with `--corners`, also in corners of the workspace that were left out
of the diagnosis. Then the effects found on one day are applied to another day's recording of the same arm; only the
instrument's pose and the marker's position are fitted again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.diagnosis.diagnosis import Diagnosis, diagnose
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.search.held_out import Blocks, held_out_errors
from bodyschema.effects import Simulation, load_simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from kbmaps.arrays import BoolArray

SETS = ("ur5_laser", "wam_laser", "ur10_laser_a", "ur10_laser_b", "panda_eyeinhand")
# Required held-out residual of each set [mm].
ASKED = {"ur5_laser": "mean ≤ 0.090", "wam_laser": "RMS ≤ 1.5"}
# Share of the rows in a corner of the workspace; opposite corners come one after the other.
OF_A_CORNER, CORNERS = 0.05, (0, 7, 3, 4, 5, 2, 6, 1)
# Required mean of each set on such corners [mm].
ASKED_OF_CORNERS = {"ur5_laser": 0.080, "wam_laser": 2.1}
ONE_DAY, ANOTHER_DAY = "ur10_laser_a", "ur10_laser_b"
ASKED_LATER = "RMS < 0.44, aim 0.33"


@dataclass(frozen=True, eq=False)
class Arm:
    """A set: the simulation of its arm and the recording."""

    simulation: Simulation
    recording: Recording

    @classmethod
    def load(cls, folder: Path, every: int) -> Arm:
        """Load every `every`-th row of the set."""
        simulation = load_simulation(folder / "robot.toml")
        whole = Recording.read(folder / "measured.csv", simulation.robot.joints)
        return cls(simulation, whole.rows(np.arange(0, len(whole), every)))


def at_random(rows: int, seed: int) -> Blocks:
    """Assign rows to folds one by one, at random."""
    blocks = Blocks.cut(rows)
    return Blocks(np.random.default_rng(seed).permutation(blocks.of_row), blocks.count)


def corner(x: FloatArray, number: int) -> BoolArray:
    """Return True for the rows (n,) farthest out in one of the eight diagonal directions of positions (n, 3) [m]."""
    centred = x - np.median(x, axis=0)
    principal = np.linalg.svd(centred, full_matrices=False)[0]
    along = principal @ np.array([1.0 if number >> k & 1 else -1.0 for k in range(3)])
    return along > np.quantile(along, 1.0 - OF_A_CORNER)


def corner_mm(arm: Arm, number: int, seed: int) -> FloatArray:
    """Return errors (n,) [mm] in a corner of the workspace, of the extended simulation found without it."""
    out = corner(arm.recording.x, number)
    found = diagnose(arm.recording.rows(np.flatnonzero(~out)), arm.simulation, seed=seed)
    there = Observations.of(arm.recording, arm.simulation).motion
    return 1e3 * np.linalg.norm(arm.recording.x - found.stored.written.positions(there), axis=1)[out]


def distances_mm(diagnosis: Diagnosis) -> FloatArray:
    """Return errors (n,) [mm] of the extended simulation on held-out rows, without fixes that are not the marker."""
    return 1e3 * diagnosis.held_out["extended"][diagnosis.markers]


def rms(distances: FloatArray) -> float:
    return float(np.sqrt(np.square(distances).mean()))


def held_out_mm(fit: Fit, kept: BoolArray) -> float:
    """Return the RMS [mm] of a fit over held-out blocks, on the rows that are kept."""
    return 1e3 * rms(np.linalg.norm(held_out_errors(fit, Blocks.cut(len(kept))), axis=1)[kept])


def row(name: str, diagnosis: Diagnosis, dealt: Diagnosis, seconds: float) -> str:
    """Return one line of the table, from diagnoses with rows held out by blocks and at random."""
    file = conclusion(diagnosis)
    n, blocks, scattered = len(diagnosis.markers), distances_mm(diagnosis), distances_mm(dealt)
    other = [c for c in file.causes if c.effect not in ("link_geometry", "joint_offset", "outliers")]
    first = max(other, key=lambda c: c.share_of_gain_percent, default=None)
    told = "–" if first is None else f"{first.effect} at {first.where}"
    figures = (
        f"{file.rms_mm.aligned:.3f}/{file.mean_mm.aligned:.3f} | {file.rms_mm.geometry:.3f}/{file.mean_mm.geometry:.3f}"
        f" | {rms(blocks):.3f}/{blocks.mean():.3f} | {rms(scattered):.3f}/{scattered.mean():.3f}"
    )
    return f"| {name} | {n:,} | {figures} | {ASKED.get(name, '–')} | {file.verdict} | {told} | {seconds:.1f} |"


def taken_along(earlier: Diagnosis, arm: Arm, later: Diagnosis) -> str:
    """Report the held-out residual of one day's effects on another day's recording, and that of the best geometry."""
    simulation = arm.simulation.with_effects(earlier.causes)
    taken = held_out_mm(aligned(Observations.of(arm.recording, simulation), simulation), later.markers)
    geometry = held_out_mm(later.geometry, later.markers)
    return (
        f"{ONE_DAY}'s effects on {ANOTHER_DAY}, re-aligned only: RMS {taken:.3f} mm, asked {ASKED_LATER}.\n"
        f"The best geometry fitted to {ANOTHER_DAY} itself: RMS {geometry:.3f} mm."
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="the folder of the sets; without it nothing is measured")
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=SETS)
    parser.add_argument("--every", type=int, default=1, help="take every so many rows of the UR10's first day")
    parser.add_argument("--corners", type=int, default=0, choices=range(9), help="of the workspace to leave out")
    parser.add_argument("--only-corners", action="store_true", help="measure nothing else")
    parser.add_argument("--seed", type=int, default=0)
    tables_option(parser)
    args = parser.parse_args(argv)
    if args.data is None:
        print(
            "The real recordings (docs/results/real_data.md) are not in this repository: give their folder as --data."
        )
        return
    mm, asked = (Column(what, "mm", "{:.3g}") for what in ("mean", "goal"))
    corners = Table("diagnosis_corners", [Column("set"), mm, Column("of the corners", "mm", "{:.3g} to {:.3g}"), asked])
    for name in args.sets if args.corners else ():
        arm = Arm.load(args.data / name, args.every if name == ONE_DAY else 1)
        errors = [corner_mm(arm, number, args.seed) for number in CORNERS[: args.corners]]
        means = [error.mean() for error in errors]
        corners.add(f"`{name}`", np.concatenate(errors).mean(), [min(means), max(means)], ASKED_OF_CORNERS.get(name))
    if corners.rows:
        corners.save(args.tables)
    if args.only_corners:
        return
    print("Errors on rows that were not fitted, RMS/mean [mm]; seconds are the processor's.\n")
    print("| set | rows | aligned | geometry | by blocks | at random | asked | verdict | first beside geometry | s |")
    print("| --- " * 10 + "|")
    found: dict[str, Diagnosis] = {}
    arms = {}
    for name in args.sets:
        arms[name] = Arm.load(args.data / name, args.every if name == ONE_DAY else 1)
        start = time.process_time()
        found[name] = diagnose(arms[name].recording, arms[name].simulation, seed=args.seed)
        seconds = time.process_time() - start
        random = at_random(len(arms[name].recording), args.seed)
        dealt = diagnose(arms[name].recording, arms[name].simulation, seed=args.seed, blocks=random)
        print(row(name, found[name], dealt, seconds), flush=True)
    if ONE_DAY in found and ANOTHER_DAY in found:
        print(f"\n{taken_along(found[ONE_DAY], arms[ANOTHER_DAY], found[ANOTHER_DAY])}")


if __name__ == "__main__":
    main()
