"""`bodyschema export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.cli.commands.options import (
    AS_THEY_ARE,
    HERE,
    DatasetCalibration,
    RobotFile,
    SourceOptions,
    flag,
    print_json,
    say,
)
from bodyschema.interfaces.errors import RequestError


def export(
    source: Annotated[
        Path,
        Parameter(
            help="A sample store (.sqlite), a recording (.csv, .parquet), a ROS bag, a LeRobotDataset, or a robot "
            "(extended.toml)."
        ),
    ],
    out: Annotated[
        Path,
        Parameter(
            help="The file; its ending says the format: .csv, .parquet, .mcap, .rrd for samples, .xml (MJCF), .urdf, "
            ".json (run-time correction) or .txt (settings of drivers) for a robot."
        ),
    ],
    /,
    *,
    robot: RobotFile = HERE,
    taken: SourceOptions = AS_THEY_ARE,
    lerobot: DatasetCalibration = None,
    measured: Annotated[
        Path | None, Parameter(help="With a robot: a recording or store; prints the errors of OUT on it.")
    ] = None,
    force: Annotated[bool, flag("Replace OUT when it is there.")] = False,
    as_json: Annotated[bool, flag("Print the result as JSON.", name="--json")] = False,
) -> None:
    """Turn samples into files of other programs, and a robot with what was found into MJCF, URDF or a correction.

    A store may be in use by a running sampler. MCAP opens in Foxglove: joints and positions under `/pair`, the marker
    under `/marker`, and the devices of the joints (servos, firmware, homing offsets) as metadata. .rrd opens in Rerun:
    the moving robot, its cameras, and the marker as measured and as predicted by robot.toml or extended.toml.

    A robot is an extended.toml that `bodyschema diagnose` wrote, or a robot.toml. Effects that the format cannot hold
    are printed, and listed in the file. examples/correction has programs that read the correction at run time.

    Needs: for a recording robot.toml, which names its joints; for Parquet and MCAP the extra `export`
    (`pip install 'bodyschema[export]'`), for .rrd the extra `rerun`. MuJoCo, if it is installed, replays the MJCF.

    Next: `bodyschema replay` on a CSV or Parquet file; `python -m mujoco.viewer --mjcf=OUT` on an MJCF file.
    """
    from bodyschema.cli.recordings.foreign import opened
    from bodyschema.cli.recordings.rerun_scene import scene_for
    from bodyschema.daemon.config import Config
    from bodyschema.recordings import files as recordings

    if source.suffix.lower() == ".toml":
        _export_robot(source, out, measured, force=force, as_json=as_json)
        return
    if measured is not None:
        raise RequestError("--measured goes with a robot: give an extended.toml in the place of SOURCE")
    recordings.check_target(out, force=force)
    if source.suffix.lower() in recordings.STORE_ENDINGS:
        recording, devices = recordings.from_store(source), recordings.devices_of(source)
    else:
        recording, devices = opened(Config.load(robot), source, taken, lerobot), []
    scene = scene_for(out, robot, recording) if robot.exists() else None
    if scene is None and out.suffix.lower() == recordings.RERUN and not as_json:
        say(f"Without robot and cameras: there is no {robot}. Give --robot")
    recordings.write(recording, out, devices, scene)
    if as_json:
        print_json({"file": str(out), "pairs": len(recording)})
    else:
        say(f"{len(recording)} samples written to {out}")


def _export_robot(source: Path, out: Path, measured: Path | None, *, force: bool, as_json: bool) -> None:
    from bodyschema.calibration.plausibility.limits import require_units
    from bodyschema.cli.terminal import robot_export
    from bodyschema.effects import load_simulation
    from bodyschema.recordings import files as recordings

    robot_export.check_target(out, force=force)
    simulation = load_simulation(source)
    recording = None
    if measured is not None:
        recording = recordings.opened(measured, simulation.robot.joints)
        require_units(simulation.robot, recording, measured)
    gaps = robot_export.write(simulation, out)
    if not as_json:
        say(*gaps)
        say(f"{simulation.robot.name} {robot_export.effects_of(simulation)} written to {out}")
    rows, why_not = ([], None) if recording is None else robot_export.compared(simulation, recording, out)
    if as_json:
        errors = [{"model": row.model, "rms_m": 1e-3 * row.rms_mm, "mean_m": 1e-3 * row.mean_mm} for row in rows]
        print_json({"file": str(out), "robot": simulation.robot.name, "not_in_it": gaps, "errors": errors})
        return
    if recording is None:
        return
    table = Table(title=Text(f"all {len(recording)} rows of {measured}, outliers included"))
    for head in ("model", "RMS [mm]", "mean [mm]", "gain [%]"):
        table.add_column(Text(head))
    for row in rows:
        gain = "" if row.gain_percent is None else f"{row.gain_percent:.1f}"
        table.add_row(row.model, f"{row.rms_mm:.3f}", f"{row.mean_mm:.3f}", gain)
    Console(highlight=False, soft_wrap=True).print(table)
    if why_not is not None:
        say(why_not)
