"""`bodyschema export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.daemon.commands.options import AS_THEY_ARE, HERE, DatasetCalibration, RobotFile, SourceOptions, flag


def export(
    source: Annotated[
        Path, Parameter(help="A pair store (.sqlite), a recording (.csv, .parquet), a ROS bag or a LeRobotDataset.")
    ],
    out: Annotated[Path, Parameter(help="The file; its ending .csv, .parquet, .mcap or .rrd says the format.")],
    /,
    *,
    robot: RobotFile = HERE,
    taken: SourceOptions = AS_THEY_ARE,
    lerobot: DatasetCalibration = None,
    force: Annotated[bool, flag("Replace OUT when it is there.")] = False,
) -> None:
    """Turn a store, a recording, a ROS bag or a LeRobotDataset into CSV, Parquet, MCAP or a Rerun file.

    A store may be in use by a running sampler. MCAP opens in Foxglove: joints and positions under `/pair`, the marker
    under `/marker`, and as metadata what the joints were read with (servos, firmware, homing offsets).

    Needs: for a recording robot.toml, which names its joints; for Parquet and MCAP the extra `export`
    (`pip install 'bodyschema[export]'`), for .rrd the extra `rerun`.

    Next: `bodyschema replay` on a CSV or Parquet file.
    """
    from rich.console import Console

    from bodyschema.daemon import recordings
    from bodyschema.daemon.config import Config

    recordings.check_target(out, force=force)
    if source.suffix.lower() in recordings.STORE_ENDINGS:
        recording, devices = recordings.from_store(source), recordings.devices_of(source)
    else:
        recording, devices = taken.opened(Config.load(robot), source, lerobot), []
    recordings.write(recording, out, devices)
    Console(highlight=False, soft_wrap=True).print(f"{len(recording)} pairs written to {out}", markup=False)
