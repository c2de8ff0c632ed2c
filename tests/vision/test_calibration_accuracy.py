"""Calibrations from rendered images of many rigs.

`python -m pytest -m soak tests/vision/test_calibration_accuracy.py -s --timeout 3600` prints the figures.

No rig is left out of the figures; one that is refused counts as a failure and is printed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calibrated_rigs import calibrated_rig

from benchmarks.tables import Column, Table

RIGS = 12
FISHEYE_EVERY = 4


@pytest.mark.soak
def test_twenty_rendered_views_give_baseline_positions_and_intervals(tables_folder: Path | None) -> None:
    results = []
    table = Table(
        "calibration_accuracy",
        [
            Column("rig", "", "{:.0f}"),
            Column("lenses"),
            Column("baseline error", "mm", "{:+.4f}"),
            Column("3-D error at 0.6 m", "mm", "{:.3f}"),
            Column("as a shape", "mm", "{:.3f}"),
            Column("held-out", "px", "{:.3f}"),
            Column("views left out", "", "{:.0f}"),
        ],
    )
    for seed in range(RIGS):
        found = calibrated_rig(seed, fisheye=seed % FISHEYE_EVERY == FISHEYE_EVERY - 1)
        results.append(found)
        if isinstance(found, str):
            table.add(seed, f"refused: {found}", None, None, None, None, None)
            continue
        errors_mm = found.baseline_mm, found.position_mm, found.shape_mm
        table.add(seed, found.model, *errors_mm, found.held_out_px, found.left_out)
    table.save(tables_folder)
    good = [each for each in results if not isinstance(each, str)]
    z, position_z = (np.abs(np.concatenate([getattr(each, name) for each in good])) for name in ("z", "position_z"))
    print(f"parameters within 1 sigma {np.mean(z < 1):.0%}, 2 sigma {np.mean(z < 2):.0%}")
    print(f"positions within 1 sigma {np.mean(position_z < 1):.0%}, 2 sigma {np.mean(position_z < 2):.0%}")
    assert len(good) == RIGS
    assert max(abs(each.baseline_mm) for each in good) <= 0.2
    assert max(each.position_mm for each in good if each.model == "pinhole") <= 0.5
    # A fisheye has half the pixels to the degree.
    assert max(each.position_mm for each in good) <= 1.0
    assert 0.5 < np.mean(z < 1.0) < 0.85
    assert np.mean(z < 2.0) > 0.85
