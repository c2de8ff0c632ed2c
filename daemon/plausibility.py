"""Whether a recording can be of this robot: its units, the order of its columns, their signs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from interfaces.errors import RecordingError
from interfaces.recording import Recording
from interfaces.records import FloatArray
from interfaces.robot import RobotDescription
from interfaces.urdf import REVOLUTE
from kbmaps import ChainTolerances, KBMapsError, RigidChain, RigidLearner, align

BoolArray = NDArray[np.bool_]

# Positions in the middle lie so far from the middle position, in units of the arm's reach, only in another unit.
FARTHEST = 2.0
# A joint of limited range is never so far beyond its limits [rad]: encoders wrap after a turn at the latest.
BEYOND_LIMITS_RAD = 2.0 * math.pi
# So large a share of rows makes it a matter of units, not of single wrong readings.
MANY = 0.1
# What a rigid chain leaves of the arm's reach, of a recording of another arm or of columns mixed up.
FAR_OFF = 0.02
# ... and what the drawn chain leaves in its best place.
FAR_OFF_AS_DRAWN = 0.2
# ... and how many times the noise that was told.
FAR_OFF_SIGMAS = 5.0
# Rows that other readings of the columns are judged by, how many readings are fitted, and how much better the named
# one has to fit.
JUDGED_ROWS, FITTED, MUCH_BETTER = 60, 4, 3.0
# ... and how much worse the one may fit that changes less.
AS_GOOD = 1.2
# As badly made as an arm may be, with what robot.toml says of camera and marker as rough as a guess.
_ROUGH = ChainTolerances(
    axes=0.06, points=0.03, zeros=0.1, slide_zeros=0.02, tool=0.1, base_rotation=0.5, base_translation=0.5
)
# Where nothing else is found.
OTHER_CAUSES = (
    "Is the recording of another robot, are its columns in another order, does a joint count the other way, or is a "
    "zero off by a quarter turn? Where the measurements are that noisy, say so with --sigma-mm"
)
_UNITS_PER_METRE = (("millimetres", 1e3), ("centimetres", 1e2))
_UNITS_PER_SECOND = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
# An arm that is guided, or goes from pose to pose, is never so slow in the middle [rad/s]; it is about so fast.
SLOWEST, USUAL = 0.005, 0.3
# So far on a slide counts as one radian [m]; so many moves there must be to judge by.
A_RADIAN_M, FEWEST_MOVES = 0.1, 20


def reach_m(robot: RobotDescription) -> float:
    """How far from the first joint the marker can be at most [m]: all links and ways end to end."""
    chain = robot.chain
    ways = np.maximum(np.abs(robot.lower), np.abs(robot.upper))[chain.prismatic]
    return float(np.linalg.norm(chain.fixed[1:, :3, 3], axis=1).sum() + ways.sum())


def beyond_limits(robot: RobotDescription, q: FloatArray, by: float = 0.0) -> BoolArray:
    """Which joints poses (..., d) [rad, m] put beyond their limits by more than `by`; a continuous joint has none."""
    limited = np.array([robot.tree.joint(name).kind != "continuous" for name in robot.joints])
    return limited & (np.maximum(robot.lower - q, q - robot.upper) > by)


def limits_text(robot: RobotDescription, joint: int) -> str:
    """A joint's limits for people, as in `-2.6 to 2.6 rad (-149° to 149°)`."""
    lower, upper = robot.lower[joint], robot.upper[joint]
    if robot.tree.joint(robot.joints[joint]).kind not in REVOLUTE:
        return f"{lower:.4g} to {upper:.4g} m"
    return f"{lower:.4g} to {upper:.4g} rad ({math.degrees(lower):.4g}° to {math.degrees(upper):.4g}°)"


def require_units(robot: RobotDescription, recording: Recording, file: Path) -> None:
    """Refuse angles and positions that no arm has in radians and metres.

    Args:
        file: what the recording is of.

    Raises:
        RecordingError: angles far beyond the limits, positions farther apart than the arm reaches, or times in which
            an arm hardly moves.
    """
    _require_radians(robot, recording, file)
    _require_metres(robot, recording, file)
    _require_seconds(robot, recording, file)


def _require_radians(robot: RobotDescription, recording: Recording, file: Path) -> None:
    beyond = beyond_limits(robot, recording.q, BEYOND_LIMITS_RAD).mean(axis=0)
    beyond[robot.chain.prismatic] = 0.0
    if beyond.max() > MANY:
        joint = int(beyond.argmax())
        extreme = recording.q[np.abs(recording.q[:, joint]).argmax(), joint]
        raise RecordingError(
            f"the joint {robot.joints[joint]!r} goes to {extreme:.4g}, with limits from {limits_text(robot, joint)}: "
            "these look like degrees",
            file=file,
            remedy="Give angles in radians: multiply by π/180",
        )


def _require_metres(robot: RobotDescription, recording: Recording, file: Path) -> None:
    spread, reach = _spread(recording.x), reach_m(robot)
    if spread > FARTHEST * reach:
        drawn = _spread(robot.chain.positions(recording.q))
        name, factor = min(_UNITS_PER_METRE, key=lambda unit: abs(math.log(spread / (unit[1] * max(drawn, 1e-9)))))
        raise RecordingError(
            f"the positions x, y, z lie about {spread:.4g} m from their middle, and the arm reaches {reach:.3g} m: "
            f"these look like {name}",
            file=file,
            remedy=f"Give positions in metres: divide by {factor:g}",
        )


def _require_seconds(robot: RobotDescription, recording: Recording, file: Path) -> None:
    if recording.t is None:
        return
    moves = np.diff(recording.q, axis=0) / np.where(robot.chain.prismatic, A_RADIAN_M, 1.0)
    gaps, steps = np.diff(recording.t), np.linalg.norm(moves, axis=1)
    inside = (gaps > 0.0) & (steps > 0.0)
    if recording.segment is not None and np.diff(recording.segment).any():
        inside &= np.diff(recording.segment) == 0
    if inside.sum() < FEWEST_MOVES:
        return
    gap, speed = float(np.median(gaps[inside])), float(np.median(steps[inside] / gaps[inside]))
    if speed < SLOWEST:
        name, factor = min(_UNITS_PER_SECOND, key=lambda unit: abs(math.log(speed * unit[1] / USUAL)))
        raise RecordingError(
            f"the times t are {gap:.4g} apart in the middle, in which the joints move by "
            f"{math.degrees(speed * gap):.2g}°: these look like {name}",
            file=file,
            remedy=f"Give times in seconds: divide by {factor:g}",
        )


def is_far_off(robot: RobotDescription, left_m: FloatArray, sigma_m: float | None, share: float = FAR_OFF) -> bool:
    """Whether a chain that leaves these distances (n,) [m] to the pairs is not this arm's.

    Args:
        sigma_m: 1-sigma of a coordinate that was told [m].
        share: of the arm's reach that may be left.
    """
    noise = 0.0 if sigma_m is None else FAR_OFF_SIGMAS * sigma_m
    return float(np.median(left_m)) > max(share * reach_m(robot), noise)


def mixed_up(robot: RobotDescription, recording: Recording, sigma_m: float | None = None) -> str | None:
    """How else to read the columns for a much better fit, as a sentence; None where that is not the matter.

    Columns may be exchanged, joints may count the other way, and positions may be mirrored, several of it together.
    Many ways to read them are tried with the drawn arm in its best place, the best of them with a learnt one.

    Args:
        sigma_m: 1-sigma of a coordinate that was told [m].
    """
    some = recording.rows(np.unique(np.linspace(0, len(recording) - 1, JUDGED_ROWS).astype(np.intp)))
    as_it_is = _Columns(tuple(range(len(robot.joints))), (1,) * len(robot.joints))
    likely = _likely(robot.chain, some, as_it_is)
    fitted = {columns: _left_by_a_learnt_chain(robot, some, columns) for columns in (as_it_is, *likely)}
    least_m = min(fitted.values())
    # A joint whose sign hardly shows is left as it is.
    for columns in [columns for columns in fitted if fitted[columns] < AS_GOOD * least_m]:
        for fewer in (fewer for fewer in columns.changed() - fitted.keys() if fewer.changes < columns.changes):
            fitted[fewer] = _left_by_a_learnt_chain(robot, some, fewer)
    good = [columns for columns in fitted if fitted[columns] < AS_GOOD * least_m]
    best = min(good, key=lambda columns: (columns.changes, fitted[columns], columns.order, columns.signs))
    if MUCH_BETTER * fitted[best] > fitted[as_it_is] or is_far_off(robot, np.array(fitted[best]), sigma_m):
        return None
    # All joints of an arm that is its own mirror image may count the other way, or its positions be mirrored.
    also = [columns for columns in good if columns.mirrored != best.mirrored]
    either = [best, *sorted(also, key=lambda columns: columns.changes)[:1]]
    return (
        f"W{' or '.join(columns.said(robot.joints) for columns in either)[1:]}, the pairs would fit to "
        f"{1e3 * fitted[best]:.3g} mm instead of {1e3 * fitted[as_it_is]:.3g} mm"
    )


@dataclass(frozen=True, slots=True)
class _Columns:
    """A way to read the columns: which one is whose joint's, and which way it counts.

    Attributes:
        order: place of the column of each joint.
        signs: 1 or -1 for each joint.
        mirrored: whether one of x, y, z counts the other way; which one is a matter of where the cameras stand.
    """

    order: tuple[int, ...]
    signs: tuple[int, ...]
    mirrored: bool = False

    def of(self, q: FloatArray) -> FloatArray:
        return q[:, self.order] * np.array(self.signs, dtype=np.float64)

    def positions(self, x: FloatArray) -> FloatArray:
        return x * [-1.0, 1.0, 1.0] if self.mirrored else x

    def changed(self) -> set[_Columns]:
        """All in which one joint more or all count the other way, two are exchanged, or positions are mirrored."""
        joints = range(len(self.order))
        turned: set[_Columns] = {replace(self, signs=_replaced(self.signs, {k: -self.signs[k]})) for k in joints}
        exchanged: set[_Columns] = {
            replace(
                self,
                order=_replaced(self.order, {j: self.order[k], k: self.order[j]}),
                signs=_replaced(self.signs, {j: self.signs[k], k: self.signs[j]}),
            )
            for j, k in itertools.combinations(joints, 2)
        }
        as_a_whole: set[_Columns] = {
            replace(self, signs=tuple(-sign for sign in self.signs)),
            replace(self, mirrored=not self.mirrored),
        }
        return turned | exchanged | as_a_whole

    @property
    def changes(self) -> int:
        """How many columns are not in their place, or count the other way; as one where it is all of them."""
        turned = self.signs.count(-1)
        moved = sum(k != column for k, column in enumerate(self.order))
        return moved + (turned if turned < len(self.signs) else 1) + self.mirrored

    def said(self, joints: tuple[str, ...]) -> str:
        return f"with {' and '.join(self._changes(joints))}"

    def _changes(self, joints: tuple[str, ...]) -> Iterator[str]:
        moved = [k for k, column in enumerate(self.order) if column != k]
        if len(moved) == 2:
            yield f"the columns {joints[moved[0]]} and {joints[moved[1]]} exchanged"
        elif moved:
            yield f"the columns in the order {', '.join(joints[k] for k in self.order)}"
        other = [joint for joint, sign in zip(joints, self.signs, strict=True) if sign < 0]
        if other and len(other) == len(joints):
            yield "all joints counting the other way"
        elif other:
            yield f"{' and '.join(other)} counting the other way"
        if self.mirrored:
            yield "the positions mirrored (a left-handed frame: one of x, y, z counting the other way)"


def _likely(chain: RigidChain, recording: Recording, as_it_is: _Columns) -> list[_Columns]:
    """The ways that fit best with the drawn chain anywhere, change by change from those that fitted best before."""
    left_m: dict[_Columns, float] = {}
    best = [as_it_is]
    for _ in range(len(as_it_is.order) + 1):
        for columns in {columns for way in best for columns in way.changed()} - left_m.keys():
            left_m[columns] = _left_in_best_place(chain, recording, columns)
        others = left_m.keys() - {as_it_is}
        before, best = best, sorted(others, key=lambda columns: (left_m[columns], columns.changes, columns.order))
        best = best[:FITTED]
        if best == before:
            break
    return best


def _replaced(values: tuple[int, ...], changes: dict[int, int]) -> tuple[int, ...]:
    return tuple(changes.get(k, value) for k, value in enumerate(values))


def _left_in_best_place(chain: RigidChain, recording: Recording, columns: _Columns) -> float:
    drawn, x = chain.positions(columns.of(recording.q)), columns.positions(recording.x)
    return float(Rotation.align_vectors(x - x.mean(axis=0), drawn - drawn.mean(axis=0))[1])


def _left_by_a_learnt_chain(robot: RobotDescription, recording: Recording, columns: _Columns) -> float:
    """Middle distance of the pairs from a chain that was learnt from them [m]."""
    q, x = columns.of(recording.q), columns.positions(recording.x)
    pose_known = robot.camera.pose_known and not columns.mirrored
    try:
        aligned = align(robot.chain, q, x, pose_known=pose_known, marker_known=robot.robot.marker_known)
        learner = RigidLearner(aligned.chain, _ROUGH)
        learner.learn(q, x)
        return float(np.median(np.linalg.norm(learner.predict(q) - x, axis=1)))
    except KBMapsError:
        return math.inf


def _spread(x: FloatArray) -> float:
    """Middle distance (n, 3) [m] from the middle position."""
    return float(np.median(np.linalg.norm(x - np.median(x, axis=0), axis=1)))
