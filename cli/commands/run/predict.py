"""`bodyschema predict`."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bodyschema.cli.commands.options import HERE, RobotFile, flag, print_json
from bodyschema.interfaces.errors import RequestError

if TYPE_CHECKING:
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.daemon.config import Config
    from bodyschema.daemon.transport.wire import JointsRequest, PredictReply
    from bodyschema.interfaces.records import FloatArray


def predict(
    *q: Annotated[float, Parameter(help="One value for each joint, in robot.toml's order [rad; m if it slides].")],
    robot: RobotFile = HERE,
    deg: Annotated[bool, flag("Angles are in degrees.")] = False,
    as_json: Annotated[bool, flag("Print the learner's reply, with the poses in SI, as JSON.", name="--json")] = False,
) -> None:
    """Ask the learner for the marker position in the measurement frame.

    Without values, reads them from standard input as JSON: one vector, or a list of them. For example:
    `bodyschema predict --deg 10 -20 30 40 0 15 5`.

    Needs: a running learner (`bodyschema run` or `bodyschema run learner`).

    Next: the same from your own program, over zenoh: docs/zenoh.md.
    """
    from bodyschema.daemon.client_config import ClientConfig
    from bodyschema.daemon.transport.keys import Keys
    from bodyschema.daemon.transport.session import client
    from bodyschema.daemon.transport.wire import JointsRequest, PredictReply, decode, encode

    config = ClientConfig.load(robot)
    with config.checked_on_error():
        rows = _rows(q, config, deg)
        with client(config.route("learner")) as bus:
            request = JointsRequest([*(rows[0] if len(rows) == 1 else rows)])
            reply = decode(bus.ask_one(Keys(config.name).predict, encode(request)), PredictReply)
    if as_json:
        print_json(reply)
        return
    _show(reply)
    limits = [config.joint_limits.get(name, ("", 0.0, 0.0)) for name in config.joints]
    beyond = (
        kind != "continuous" and not lower <= value <= upper
        for row in rows
        for value, (kind, lower, upper) in zip(row, limits, strict=True)
    )
    if any(beyond):
        _show_notes(config, rows, deg)


def _show_notes(config: ClientConfig, rows: list[list[float]], deg: bool) -> None:
    """Show remarks on joint values [rad, m] that are impossible for the arm."""
    import numpy as np

    from bodyschema.daemon.config import Config

    for note in _notes(Config.load(config.file), np.array(rows), deg):
        Console(highlight=False).print(note, style="yellow", markup=False)


def _notes(config: Config, q: FloatArray, deg: bool) -> Iterator[str]:
    """Yield remarks on joint values q (n, d) [rad, m] that are impossible for the arm."""
    import numpy as np

    from bodyschema.calibration.plausibility.limits import beyond_limits, limits_text

    beyond = beyond_limits(config.robot, q)
    for joint in np.flatnonzero(beyond.any(axis=0)):
        worst = q[beyond[:, joint], joint][np.abs(q[beyond[:, joint], joint]).argmax()]
        unit = " m" if config.robot.chain.prismatic[joint] else " rad"
        forgotten = "" if deg or unit == " m" else ". --deg takes degrees"
        limits = limits_text(config.robot, int(joint))
        yield (
            f"{config.robot.joints[joint]} cannot be at {worst:.4g}{unit}: its limits are {limits}{forgotten}. The "
            "answer is the model's all the same"
        )


def _rows(values: tuple[float, ...], config: ClientConfig, deg: bool) -> list[list[float]]:
    """Return the vectors of joint values [rad, m]; raise RequestError if the input contains none."""
    from bodyschema.daemon.transport.wire import JointsRequest, joint_angles, joint_rows

    if values:
        request = JointsRequest(list(values))
    elif sys.stdin.isatty():
        raise RequestError(f"no joint angles; give {len(config.joints)} ({', '.join(config.joints)}), or JSON on stdin")
    else:
        request = _from_standard_input(config)
    rows = joint_rows(request, config.joints)
    if not all(math.isfinite(value) for row in rows for value in row):
        joint_angles(request, config.joints)  # which names the place
    if not deg:
        return rows
    slides = config.slides
    return [[value if is_m else math.radians(value) for value, is_m in zip(row, slides, strict=True)] for row in rows]


def _from_standard_input(config: ClientConfig) -> JointsRequest:
    from bodyschema.daemon.transport.wire import JointsRequest, decode

    text = sys.stdin.buffer.read()
    names = ", ".join(config.joints)
    if not text.strip():
        raise RequestError(f"no joint angles, and standard input is empty; give {len(config.joints)} ({names})")
    try:
        return decode(b'{"q":' + text + b"}", JointsRequest)
    except RequestError as error:
        expected = f"a JSON list of {len(config.joints)} numbers ({names}), or a list of such lists"
        raise RequestError(f"standard input is not {expected}") from error


def _show(reply: PredictReply) -> None:
    from bodyschema.cli.terminal.screen import two_digits

    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("x", "y", "z", "1-sigma of x, y, z"):
        table.add_column(Text(f"{name} [mm]"), justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    for x, sigma, inside in zip(reply.x, reply.sigma, reply.in_support, strict=True):
        spread = ", ".join(two_digits(1e3 * value) for value in sigma)
        where = "where data was" if inside else "away from all data"
        table.add_row(*(f"{1e3 * value:.1f}" for value in x), spread, where)
    console = Console(highlight=False)
    console.print(table)
    age = "none since it started" if reply.age_s is None else f"the newest {reply.age_s:.1f} s old"
    console.print(f"model {reply.model}, {reply.pairs} samples learnt, {age}", style="dim")
