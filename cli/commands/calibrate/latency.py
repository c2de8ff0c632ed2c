"""`bodyschema calibrate latency`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

from bodyschema.cli.commands.options import HERE, RobotFile, flag, print_json, say
from bodyschema.interfaces.errors import BodyschemaError, ConfigError

if TYPE_CHECKING:
    from bodyschema.calibration.latency import Wiggle
    from bodyschema.daemon.config import Config


def latency(
    recording: Annotated[
        Path | None, Parameter(help="What an earlier call saved; else the arm and the cameras themselves.")
    ] = None,
    /,
    *,
    robot: RobotFile = HERE,
    seconds: Annotated[float, Parameter(help="How long the arm is moved [s].", validator=Number(gte=3, lte=120))] = 5.0,
    sim: Annotated[bool, flag("The simulated robot in the place of the hardware: to see it done.")] = False,
    save: Annotated[Path | None, Parameter(help="Keep readings and positions in this CSV file.")] = None,
    write: Annotated[bool, flag("Put the latency into robot.toml; without it the change is shown.")] = False,
    as_json: Annotated[bool, flag("Print the figures as JSON.", name="--json")] = False,
) -> None:
    """Measure the latency of the cameras' timestamps, with its uncertainty. Move the arm by hand for 5 s.

    Move it to and fro, quickly but unevenly, with more than one joint and the marker in sight of both cameras. The
    estimate is the time shift at which the marker follows the joint angles best. No calibrated model is needed:
    deviations of the arm from its URDF are fitted along.

    Needs: robot.toml with encoders and cameras, and no running sampler; or a recording; or --sim.

    Next: the same with --write, which puts latency_s and latency_sigma_s into [vision.cameras], or [marker_source]. The
    old file is kept as robot.toml.before.
    """
    from bodyschema.calibration.latency import latency_of
    from bodyschema.cli.hardware.wiggling import write_wiggle
    from bodyschema.daemon.config import Config
    from bodyschema.robot.toml_text import difference, with_values, write_edited

    config = Config.load(robot)
    is_sent = not sim and config.tables.vision.cameras is None and bool(config.tables.marker_source)
    table = "marker_source" if is_sent else "vision.cameras"
    wiggle = _wiggle(config, recording, seconds, sim=sim)
    if save is not None:
        write_wiggle(wiggle, config.robot.joints, save)
    found = latency_of(wiggle, config.robot.chain)
    values = {"latency_s": round(found.latency_s, 4), "latency_sigma_s": round(found.sigma_s, 4)}
    if as_json:
        print_json(found)
    else:
        say(
            f"{found.fixes} fixes at {found.speed_m_s:.2f} m/s, {1e3 * found.residual_m:.1f} mm from where the angles "
            f"bring the marker: images are taken {1e3 * found.latency_s:.1f} ± {1e3 * found.sigma_s:.1f} ms before "
            "their time stamps."
        )
    if sim or (as_json and not write):
        return
    if not as_json:
        say(*(f"{key} = {value}" for key, value in values.items()))
    try:
        edited = with_values(config.robot.file, table, values)
    except ConfigError as error:
        if write:
            raise
        say(str(error))
        return
    changed = difference(config.robot.file, edited)
    backup = write_edited(config.robot.file, edited) if write else None
    if not as_json:
        say(*changed, f"Written; the old file is {backup}" if write else "Nothing is written without --write.")


def _wiggle(config: Config, recording: Path | None, seconds: float, *, sim: bool) -> Wiggle:
    from bodyschema.cli.hardware.wiggling import collected, read_wiggle
    from bodyschema.daemon.wiring.wiring import open_sources

    if recording is not None and sim:
        raise BodyschemaError("give a recording or --sim, not both")
    if recording is not None:
        return read_wiggle(recording, config.robot.joints)
    console = Console(stderr=True, highlight=False)
    seen = config.tables.vision.cameras or next(iter(config.tables.marker_source), None)
    known_s = 0.0 if sim or seen is None else seen.latency_s
    with open_sources(config, sim=sim) as sources, console.status("move the arm to and fro, unevenly") as status:
        seen = collected(sources, seconds, lambda t: status.update(f"go on moving: {max(seconds - t, 0):.0f} s"))
    say(*filter(None, (*seen.health, seen.summary)), stderr=True)
    return seen.wiggle.with_stamps_later(known_s)  # as the camera sent them, before robot.toml's latency was subtracted
