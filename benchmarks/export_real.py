"""Compare the gain of exported models in MuJoCo with the prediction of `diagnose`, on held-out measurements.

    python -m benchmarks.export_real --data $DATA

Three tenths of each recording are held out, in blocks. The rest is diagnosed, and exported as MJCF and correction.json.
MuJoCo and examples/correction/correction.py then predict the held-out rows from their readings. *Before* is the robot
as described, aligned with the diagnosed rows. The gain should lie in the interval stated in diagnosis.json.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables import Column, Table, tables_option
from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.effects import Motion, load_simulation
from bodyschema.effects.exports import replayed, write_correction, write_mjcf
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording

READERS = Path(__file__).resolve().parents[1] / "examples" / "correction"
ROBOTS = ("ur5_laser", "wam_laser", "tiago_eyehand")
TENTHS, HELD_OUT = 10, (1, 4, 7)
DRAWS = 2000


def corrected(file: Path, q: FloatArray) -> FloatArray:
    """Return positions (n, 3) [m] by the Python reader of correction.json."""
    sys.path.insert(0, str(READERS))
    reader = importlib.import_module("correction").Correction(file.read_text(encoding="utf-8"))
    return np.array([reader.read(row)[1][3::4] for row in q.tolist()])


def rms_mm(distances: FloatArray) -> float:
    """Return the RMS [mm] of distances (n,) [m]."""
    return float(1e3 * np.sqrt(np.square(distances).mean()))


def gain(before: FloatArray, after: FloatArray, blocks: NDArray[np.int64]) -> list[float]:
    """Return the decrease of the RMS [%], with the 95 % interval over resampled blocks of rows."""
    numbers, rng = np.unique(blocks), np.random.default_rng(0)
    sums = np.array([[np.square(d[blocks == b]).sum() for d in (before, after)] for b in numbers])
    drawn = sums[rng.integers(len(numbers), size=(DRAWS, len(numbers)))].sum(axis=1)
    low, high = np.quantile(100.0 * (1.0 - np.sqrt(drawn[:, 1] / drawn[:, 0])), [0.025, 0.975])
    return [100.0 * (1.0 - rms_mm(after) / rms_mm(before)), low, high]


def row(folder: Path) -> list[object]:
    """Return the cells of one row of the table."""
    simulation = load_simulation(folder / "robot.toml")
    recording = Recording.read(folder / "measured.csv", simulation.robot.joints)
    tenth = np.arange(len(recording)) * TENTHS // len(recording)
    held = np.isin(tenth, HELD_OUT)
    known, asked = recording.rows(~held), recording.rows(held)
    diagnosis = diagnose(known, simulation)
    gains = conclusion(diagnosis).gain
    # The held-out rows, too, contain fixes that are not the marker.
    promised = gains.with_outliers_ci95 or gains.ci95
    start = aligned(Observations.of(known, simulation), simulation).simulation
    written = diagnosis.stored.written
    with tempfile.TemporaryDirectory() as name:
        mjcf, correction = Path(name) / "model.xml", Path(name) / "correction.json"
        write_mjcf(written, mjcf, "a benchmark")
        write_correction(written, correction, "a benchmark")
        predicted = {
            "before": start.positions(Motion.of(asked)),
            "mjcf": replayed(mjcf, simulation.robot.joints, Motion.of(asked)),
            "correction": corrected(correction, asked.q),
        }
    left = {name: np.linalg.norm(x - asked.x, axis=1) for name, x in predicted.items()}
    # Adjacent rows are not independent: resample thirty blocks of them.
    blocks = np.arange(len(asked)) * 30 // len(asked)
    cells: list[object] = [f"`{folder.name}`", [len(known), len(asked)], rms_mm(left["before"])]
    percent = gains.held_out_percent if gains.with_outliers_percent is None else gains.with_outliers_percent
    cells.append([percent, *promised])
    for name in ("mjcf", "correction"):
        cells += [rms_mm(left[name]), gain(left["before"], left[name], blocks)]
    return cells


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="The folder of the recordings.")
    tables_option(parser)
    given = parser.parse_args()
    interval = "{:.1f} [{:.1f}, {:.1f}]"
    columns = [
        Column("recording"),
        Column("rows diagnosed, held out", "", "{}, {}"),
        Column("before", "mm", "{:.3g}"),
        Column("promised by `diagnose`", "%", interval),
        Column("MJCF in MuJoCo", "mm", "{:.3g}"),
        Column("gain", "%", interval),
        Column("correction.json", "mm", "{:.3g}"),
        Column("gain", "%", interval),
    ]
    table = Table("export_real", columns)
    for robot in ROBOTS:
        table.add(*row(given.data / robot))
    table.save(given.tables)


if __name__ == "__main__":
    main()
