"""`bodyschema simulate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.options import SourceRobotFile, flag, print_json, robot_file, say
from bodyschema.interfaces.errors import RequestError


def simulate(
    *,
    like: Annotated[
        Path, Parameter(help="A recording (.csv, .parquet) or a sample store (.sqlite): the joint angles.")
    ],
    robot: SourceRobotFile = None,
    out: Annotated[
        Path | None, Parameter(help="The file (.csv, .parquet, .mcap, .rrd); else CSV goes to standard output.")
    ] = None,
    noise: Annotated[bool, flag("Add the noise of the positions: as in LIKE, else as in [camera].")] = False,
    seed: Annotated[int, Parameter(help="Of the noise.", validator=Number(gte=0))] = 0,
    force: Annotated[bool, flag("Replace OUT when it is there.")] = False,
    as_json: Annotated[bool, flag("Print the result as JSON; needs --out.", name="--json")] = False,
) -> None:
    """Simulate what would have been measured at the joint angles of a recording.

    The robot is that of a robot.toml, or of an extended.toml with its `[[effects]]` (docs/effects.md). The columns are
    t and segment, where the recording has them, the joints, and x, y, z.

    Needs: a recording and a robot.toml; no hardware, no running daemon.

    Next: `bodyschema compare LIKE OUT`.
    """
    import numpy as np

    from bodyschema.calibration.plausibility.limits import require_units
    from bodyschema.cli.recordings.rerun_scene import scene_for
    from bodyschema.cli.recordings.synthesis import simulated, with_noise, without_consequence
    from bodyschema.effects import load_simulation
    from bodyschema.recordings import files as recordings

    if out is not None:
        recordings.check_target(out, force=force)
    elif as_json:
        raise RequestError("--json needs --out: without it the rows themselves go to standard output")
    robot = robot_file(robot, like)
    simulation = load_simulation(robot)
    recording = recordings.opened(like, simulation.robot.joints)
    require_units(simulation.robot, recording, like)
    result = simulated(simulation, recording)
    if noise:
        result = with_noise(simulation, result, recording, np.random.default_rng(seed))
    for sentence in without_consequence(simulation, recording):
        Console(stderr=True, highlight=False, soft_wrap=True).print(sentence, style="yellow", markup=False)
    if out is None:
        result.write_csv_to(sys.stdout)
        return
    recordings.write(result, out, scene=scene_for(out, robot, result))
    count = len(simulation.effects)
    if as_json:
        print_json({"file": str(out), "robot": simulation.robot.name, "rows": len(result), "effects": count})
        return
    effects = "without effects" if not count else f"with {count} effect{'s' if count > 1 else ''}"
    say(f"{len(result)} rows of {simulation.robot.name}, {effects}, written to {out}")
