"""Check of a recording's units against the robot's limits and reach."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.urdf import REVOLUTE
from kbmaps import RigidChain

BoolArray = NDArray[np.bool_]


class LimitSettings:
    # Only in another unit can the median distance from the median position reach this many times the arm's reach.
    farthest: float = 2.0
    # A joint of limited range is never this far beyond its limits [rad]: encoders wrap after a turn at the latest.
    beyond_limits_rad: float = 2.0 * math.pi
    many: float = 0.1  # a share of rows this large indicates wrong units, not single wrong readings
    # Rows used to determine a unit of length; largest residual of a fit in it, as a share of the nominal positions'
    # spread.
    fitted_rows: int = 80
    fitting: float = 0.1
    # If none fits, the unit is guessed from the size of the positions: the next one too if it is off by less than a
    # factor.
    also: float = 2.0
    # Median speed of an arm that is guided or goes from pose to pose [rad/s]: lower bound, and usual value.
    slowest: float = 0.005
    usual: float = 0.3
    # A fit is measured by this share of the rows, the nearest ones: outliers and rows with another tool are left out.
    measured_share: float = 0.7
    # 1-sigma of joint offsets and marker. All arms with offsets of 10° and a marker off by 0.3 m are placed.
    zeros_rad, slides_m, tool_m = 0.15, 0.05, 0.3
    # ... and a marker whose place is known, by ruler.
    known_tool_m: float = 0.01
    # Stroke that counts as one radian [m], and the minimum number of moves for a verdict.
    a_radian_m, min_moves = 0.1, 20


# Divisors that convert other units to metres.
UNITS_PER_METRE = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37, "feet": 3.281}
_UNITS_PER_SECOND = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))


def place_an_arm(rows: int, joints: int) -> bool:
    """Return True if pairs have twice as many coordinates as the arm, camera and marker have offsets."""
    return 3 * rows >= 2 * (joints + 9)


def reach_m(robot: RobotDescription) -> float:
    """Return an upper bound of the marker's distance from the first joint [m]: all links and strokes end to end."""
    chain = robot.chain
    ways = np.maximum(np.abs(robot.lower), np.abs(robot.upper))[chain.prismatic]
    return float(np.linalg.norm(chain.fixed[1:, :3, 3], axis=1).sum() + ways.sum())


def beyond_limits(robot: RobotDescription, q: FloatArray, by: float = 0.0) -> BoolArray:
    """Return True for each joint that poses (..., d) [rad, m] put more than `by` beyond its limits.

    A continuous joint has no limits.
    """
    limited = np.array([robot.tree.joint(name).kind != "continuous" for name in robot.joints])
    return limited & (np.maximum(robot.lower - q, q - robot.upper) > by)


def limits_text(robot: RobotDescription, joint: int) -> str:
    """Return a joint's limits for messages, as in `-2.6 to 2.6 rad (-149° to 149°)`."""
    lower, upper = robot.lower[joint], robot.upper[joint]
    if robot.tree.joint(robot.joints[joint]).kind not in REVOLUTE:
        return f"{lower:.4g} to {upper:.4g} m"
    return f"{lower:.4g} to {upper:.4g} rad ({math.degrees(lower):.4g}° to {math.degrees(upper):.4g}°)"


def require_units(robot: RobotDescription, recording: Recording, file: Path) -> None:
    """Refuse angles and positions that are impossible for an arm in radians and metres.

    Raises:
        RecordingError: angles far beyond the limits, positions farther apart than the arm reaches, or times in which
            an arm hardly moves.
    """
    _require_radians(robot, recording, file)
    _require_metres(robot, recording, file)
    _require_seconds(robot, recording, file)


def _require_radians(robot: RobotDescription, recording: Recording, file: Path) -> None:
    beyond = beyond_limits(robot, recording.q, LimitSettings.beyond_limits_rad).mean(axis=0)
    beyond[robot.chain.prismatic] = 0.0
    if beyond.max() > LimitSettings.many:
        joint = int(beyond.argmax())
        extreme = recording.q[np.abs(recording.q[:, joint]).argmax(), joint]
        raise RecordingError(
            f"the joint {robot.joints[joint]!r} goes to {extreme:.4g}, with limits from {limits_text(robot, joint)}: "
            "these look like degrees",
            file=file,
            remedy="Give angles in radians: multiply by π/180",
        )


def _require_metres(robot: RobotDescription, recording: Recording, file: Path) -> None:
    spread, reach = spread_m(recording.x), reach_m(robot)
    if spread > LimitSettings.farthest * reach:
        units = _likely_units(robot.chain, recording)
        raise RecordingError(
            f"the positions x, y, z lie about {spread:.4g} m from their middle, and the arm reaches {reach:.3g} m: "
            f"these look like {' or '.join(units)}",
            file=file,
            remedy=f"Give positions in metres: divide by {' or '.join(f'{UNITS_PER_METRE[unit]:g}' for unit in units)}",
        )


def _likely_units(chain: RigidChain, recording: Recording) -> list[str]:
    """Return the unit in which the nominal arm fits the positions; if none fits, one or two by their size."""
    from kbmaps.chains.placement import place  # imports scipy, which `predict` starts without

    rows = np.unique(np.linspace(0, len(recording.q) - 1, LimitSettings.fitted_rows).astype(np.intp))
    q, x, factors = recording.q[rows], recording.x[rows], np.array(list(UNITS_PER_METRE.values()))
    drawn = max(spread_m(chain.positions(q)), 1e-9)
    placed = place(
        chain,
        np.broadcast_to(q, (len(factors), *q.shape)),
        x / factors[:, None, None],
        zeros_std=np.where(chain.prismatic, LimitSettings.slides_m, LimitSettings.zeros_rad),
        tool_std=LimitSettings.tool_m,
    )
    errors = dict(zip(UNITS_PER_METRE, placed.errors(LimitSettings.measured_share).tolist(), strict=True))
    best = min(errors, key=errors.__getitem__)
    if errors[best] < LimitSettings.fitting * drawn:
        return [best]
    off = {unit: abs(math.log(spread_m(x) / (factor * drawn))) for unit, factor in UNITS_PER_METRE.items()}
    nearest = sorted(off, key=off.__getitem__)
    return nearest[: 2 if off[nearest[1]] < math.log(LimitSettings.also) else 1]


def _require_seconds(robot: RobotDescription, recording: Recording, file: Path) -> None:
    if recording.t is None:
        return
    moves = np.diff(recording.q, axis=0) / np.where(robot.chain.prismatic, LimitSettings.a_radian_m, 1.0)
    gaps, steps = np.diff(recording.t), np.linalg.norm(moves, axis=1)
    inside = (gaps > 0.0) & (steps > 0.0)
    if recording.segment is not None and np.diff(recording.segment).any():
        inside &= np.diff(recording.segment) == 0
    if inside.sum() < LimitSettings.min_moves:
        return
    gap, speed = float(np.median(gaps[inside])), float(np.median(steps[inside] / gaps[inside]))
    if speed < LimitSettings.slowest:
        name, factor = min(_UNITS_PER_SECOND, key=lambda unit: abs(math.log(speed * unit[1] / LimitSettings.usual)))
        raise RecordingError(
            f"the times t are {gap:.4g} apart in the middle, in which the joints move by "
            f"{math.degrees(speed * gap):.2g}°: these look like {name}",
            file=file,
            remedy=f"Give times in seconds: divide by {factor:g}",
        )


def spread_m(x: FloatArray) -> float:
    """Return the median distance [m] of positions (n, 3) from the median position."""
    return float(np.median(np.linalg.norm(x - np.median(x, axis=0), axis=1)))
