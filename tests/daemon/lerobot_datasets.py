"""Datasets laid out as LeRobot writes them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bodyschema.robot.lerobot import RAD_PER_TICK, Calibrations, Unit

FPS = 30


def write_dataset(
    folder: Path,
    version: str,
    unit: Unit,
    motors: Calibrations,
    episodes: Sequence[tuple[np.ndarray, np.ndarray]],
    *,
    names: object = None,
    **info: object,
) -> Path:
    """Write a dataset of Feetech arms in the layout 2.1 or 3.0; each episode is times (n,) and angles (n, k) [rad]."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (folder / "meta").mkdir(parents=True)
    told = [f"{name}.pos" for name in motors] if names is None else names
    described = {"codebase_version": version, "robot_type": "so101_follower", "fps": FPS} | info
    described["features"] = {"observation.state": {"dtype": "float32", "shape": [len(motors)], "names": told}}
    (folder / "meta" / "info.json").write_text(json.dumps(described))
    tables = []
    for number, (t, q) in enumerate(episodes):
        ticks = q / RAD_PER_TICK + [motor.middle for motor in motors.values()]
        columns = [motor.readings(ticks[:, k], unit, "feetech") for k, motor in enumerate(motors.values())]
        state = np.column_stack(columns).astype(np.float32)
        tables.append(
            pa.table(
                {
                    "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), len(motors)),
                    "timestamp": t.astype(np.float32),
                    "episode_index": np.full(len(t), number),
                }
            )
        )
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version.startswith("v3"):
        pq.write_table(pa.concat_tables(tables), chunk / "file-000.parquet")
        return folder
    for number, table in enumerate(tables):
        pq.write_table(table, chunk / f"episode_{number:06d}.parquet")
    return folder
