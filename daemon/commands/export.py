"""`bodyschema export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.daemon.commands.options import HERE, RobotFile, flag


def export(
    source: Annotated[Path, Parameter(help="A pair store (.sqlite) or a recording (.csv, .parquet).")],
    out: Annotated[Path, Parameter(help="The file; its ending .csv, .parquet, .mcap or .rrd says the format.")],
    /,
    *,
    robot: RobotFile = HERE,
    force: Annotated[bool, flag("Replace OUT when it is there.")] = False,
) -> None:
    """Turn a store or a recording into CSV, Parquet, MCAP or a Rerun file.

    A store may be in use by a running sampler. MCAP opens in Foxglove: joints and positions under `/pair`, the marker
    under `/marker`, and as metadata what the joints were read with (servos, firmware, homing offsets).

    Needs: for a recording robot.toml, which names its joints; for Parquet and MCAP the extra `export`
    (`pip install 'bodyschema[export]'`), for .rrd the extra `rerun`.

    Next: `bodyschema replay` on a CSV or Parquet file.
    """
    from rich.console import Console

    from bodyschema.daemon import recordings
    from bodyschema.interfaces.recording import Recording
    from bodyschema.interfaces.robot import RobotDescription

    recordings.check_target(out, force=force)
    if source.suffix.lower() in recordings.STORE_ENDINGS:
        recording, devices = recordings.from_store(source), recordings.devices_of(source)
    else:
        recording, devices = Recording.read(source, RobotDescription.load(robot).joints), []
    recordings.write(recording, out, devices)
    Console(highlight=False, soft_wrap=True).print(f"{len(recording)} pairs written to {out}", markup=False)
