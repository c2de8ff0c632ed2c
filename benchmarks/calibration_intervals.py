"""Coverage of a calibration's intervals: `python benchmarks/calibration_intervals.py [--rigs N] [--first SEED]`.

Random rigs of two webcams, half of them with fisheye lenses, are calibrated from 20 rendered pairs of a board, with
their own lens model. Ideally 68 % of the parameters lie within one claimed sigma and 95 % within two. No rig is
skipped; refused ones are printed. Ctrl-C ends early and prints the table.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tables import Column, Table, tables_option
from bodyschema.vision.rig.lens import Model

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "vision"))

from calibrated_rigs import Figures, calibrated_rig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=72)
    parser.add_argument("--first", type=int, default=1000, help="the first rig's seed")
    tables_option(parser)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    found: dict[Model, list[Figures]] = {"pinhole": [], "fisheye": []}
    try:
        for seed in range(arguments.first, arguments.first + arguments.rigs):
            lenses: Model = "fisheye" if seed % 2 else "pinhole"
            figures = calibrated_rig(seed, fisheye=lenses == "fisheye", model=lenses)
            if isinstance(figures, str):
                print(f"rig {seed} ({lenses}) refused: {figures}")
                continue
            found[lenses].append(figures)
            print(f"rig {seed} ({lenses}): baseline off by {figures.baseline_mm:+.4f} mm", file=sys.stderr)
    except KeyboardInterrupt:
        print("Stopped; so far:")
    table = Table(
        "calibration_intervals",
        [
            Column("lenses"),
            Column("rigs", "", "{}"),
            Column("parameters within 1 sigma, 2 sigma", "%", "{:.0f}, {:.0f}"),
            Column("baseline off, RMS", "mm", "{:.4f}"),
            Column("the most", "mm", "{:.4f}"),
            Column("mean in its sigmas", "", "{:+.2f} ± {:.2f}"),
        ],
    )
    for lenses, rigs in found.items():
        if rigs:
            table.add(lenses, *cells(rigs))
    table.save(arguments.tables)


def cells(rigs: list[Figures]) -> list[object]:
    """Return the figures of a row."""
    z = np.abs(np.concatenate([each.z for each in rigs]))
    off_mm = np.array([each.baseline_mm for each in rigs])
    in_sigmas = off_mm / [each.baseline_sigma_mm for each in rigs]
    within = [100.0 * np.mean(z < 1), 100.0 * np.mean(z < 2)]
    mean = [in_sigmas.mean(), 1.0 / np.sqrt(len(rigs))]
    return [len(rigs), within, np.sqrt(np.mean(off_mm**2)), np.abs(off_mm).max(), mean]


if __name__ == "__main__":
    main()
