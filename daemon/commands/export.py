"""`bodyschema export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter


def export(
    source: Annotated[Path, Parameter(help="A pair store (.sqlite) or a recording (.csv, .parquet).")],
    out: Annotated[Path, Parameter(help="The file to write; its ending .csv, .parquet or .mcap says the format.")],
    /,
    *,
    robot: Annotated[Path, Parameter(help="robot.toml; names the joints of a recording.")] = Path("robot.toml"),
    force: Annotated[bool, Parameter(help="Replace OUT when it is there.", negative="")] = False,
) -> None:
    """Turn a store or a recording into CSV, Parquet or MCAP.

    A store knows its joints and may be in use by a running sampler; a recording needs robot.toml. Parquet and MCAP
    need the extra `export` (`pip install 'bodyschema[export]'`). MCAP opens in Foxglove: joints and positions under
    `/pair`, the marker under `/marker`. Next: `bodyschema replay` on a CSV or Parquet file.
    """
    from rich.console import Console

    from daemon import recordings
    from interfaces.recording import Recording
    from interfaces.robot import RobotDescription

    recordings.check_target(out, force=force)
    if source.suffix.lower() in recordings.STORE_ENDINGS:
        recording = recordings.from_store(source)
    else:
        recording = Recording.read(source, RobotDescription.load(robot).joints)
    recordings.write(recording, out)
    Console(highlight=False, soft_wrap=True).print(f"{len(recording)} pairs written to {out}", markup=False)
