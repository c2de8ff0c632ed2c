"""Define unnamed error families: smooth errors of a joint, a link, the tool or the cameras."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations_with_replacement, product
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np

from bodyschema.effects import Effect, PipelineRun
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import FloatArray
from kbmaps.rotations import cross_matrix

from .vergence import by_turn, correct


class _Settings:
    """Settings of the families.

    Sensitivity, each at 0.3 and 3 times over the three recordings of family_fits.py: `harmonics` at 3 times cost so
    much that wrong causes are named; fewer `harmonics` or `times` change what is rejected. The others change nothing.
    """

    # Harmonics of a joint's angle; waves over time of a body, and of a joint, each with so many rows to a half wave.
    harmonics, times, joint_times, rows_a_wave = 5, 4, (8, 32, 96), 10
    warming = (0.07, 0.2, 0.6)  # time constants, as shares of the recording's duration
    shortest = 0.02  # a shorter link does not bend [m]
    shows = 0.05  # smallest share of the variance at which an error counts as depending on a joint
    # Limit of extrapolation beyond the observed range, as a share of it.
    beyond = 0.1


Columns = Callable[[PipelineRun], FloatArray]


@dataclass(frozen=True, eq=False)
class DiscrepancyFamily:
    """One family of smooth errors."""

    what: str  # short description
    # the erring part: a joint, a body (a link, the tool, the camera), the place in the image, or the clock
    kind: Literal["joint", "body", "place", "clock"]
    joint: int | None  # the erring joint, or the joint after the erring link; None where there is no single joint
    drivers: tuple[int, ...]  # the one or two joints on which alone it depends; empty for other families
    over_time: bool  # True if it depends on time
    moves: Columns  # displacements (n, 3, a) [m] per unit of each motion
    amounts: Columns  # functions (n, b) that it may depend on; each motion is a linear combination of them
    # instead, each motion is proportional to its own amount (b = a), by factors that are these mixtures (a, p) of the
    # parameters; None for free functions
    ties: FloatArray | None = None
    is_specific: bool = False  # True if it is as specific as a named effect
    # function from measured positions (n, 3) and parameters (p,) to the positions (n, 3) without it; None where
    # subtracting the linear columns is exact
    correct: Callable[[FloatArray, FloatArray], FloatArray] | None = None

    def columns(self, run: PipelineRun) -> FloatArray:
        """Return derivatives (n, 3, p) [m] of the measured positions by its parameters; p = a b if none are tied."""
        moved, functions = self.moved(run), self.functions(run)
        return (moved[:, :, :, None] * functions[:, None, None, :]).reshape(len(moved), 3, -1)

    def moved(self, run: PipelineRun) -> FloatArray:
        """Return displacements (n, 3, m) [m], each scaled by any of `functions`; ties are already applied."""
        moves = self.moves(run)
        return moves if self.ties is None else (moves * self.amounts(run)[:, None, :]) @ self.ties

    def functions(self, run: PipelineRun) -> FloatArray:
        """Return the functions (n, a) that each of `moved` may depend on; ones if they are tied."""
        return self.amounts(run) if self.ties is None else np.ones((len(run.motion), 1))

    def along(self, functions: FloatArray) -> DiscrepancyFamily:
        """Return the subfamily whose motions follow given combinations (b, r) of the functions."""
        return replace(self, amounts=lambda run: self.amounts(run) @ functions)

    def moved_by(self, run: PipelineRun, numbers: FloatArray) -> FloatArray:
        """Return the amount of each motion (n, a) for given parameters (p,)."""
        amounts = self.amounts(run)
        if self.ties is not None:
            return amounts * (self.ties @ numbers)
        return amounts @ numbers.reshape(-1, amounts.shape[1]).T


def families(run: PipelineRun) -> list[DiscrepancyFamily]:
    """Return all families that this motion can show."""
    robot, motion = run.simulation.robot, run.motion
    joints = [k for k in range(motion.q.shape[1]) if np.ptp(motion.q[:, k]) > 1e-4]
    names, timed = robot.joints, motion.t is not None
    found = []
    for k in joints:
        joint, link = _joint(k), _link(k)
        for j in joints:
            what = f"an error of {names[k]} that depends on {names[j]}"
            found.append(DiscrepancyFamily(what, "joint", k, (j,), False, joint, _any_of_joint(j)))
            if j != k:
                what = f"an error of {names[k]} that depends on itself and {names[j]} together"
                found.append(DiscrepancyFamily(what, "joint", k, (k, j), False, joint, _any_of_both(k, j)))
        if timed:
            what = f"an error of {names[k]} that changes with time"
            for count in (count for count in _Settings.joint_times if _Settings.rows_a_wave * count < len(motion)):
                found.append(DiscrepancyFamily(what, "joint", k, (), True, joint, _any_of_time(count)))
            what = f"the link before {names[k]} changes with time"
            found.append(DiscrepancyFamily(what, "body", k, (), True, link, _warming_or_any_of_time))
        if run.simulation.shows_weight:
            found += _yielding_supports(run, k)
    if timed:
        for what, moves in (("the tool changes with time", _tool), ("the camera moves with time", _camera)):
            found.append(DiscrepancyFamily(what, "body", None, (), True, moves, _warming_or_any_of_time))
        if robot.calibration is not None:
            what = "the lens refocuses: its focal length wanders"
            for count in (count for count in _Settings.joint_times if _Settings.rows_a_wave * count < len(motion)):
                found.append(DiscrepancyFamily(what, "place", None, (), True, _along_axis, _any_of_time(count)))
        for what, amounts in (
            ("the clocks of images and joints run apart", _shares_of_time),
            ("how late the images are changes with time", _waves_of_time),
        ):
            is_linear = amounts is _shares_of_time
            found.append(
                DiscrepancyFamily(what, "clock", None, (), True, _per_second_late, amounts, is_specific=is_linear)
            )
    for degree in (2, 3):
        what = "an error of depth that depends on where the marker is in the image"
        found.append(DiscrepancyFamily(what, "place", None, (), False, _in_depth, _places_in_image(degree)))
        what = "an error that depends on where the marker is in the image"
        found.append(DiscrepancyFamily(what, "place", None, (), False, _anywhere, _places_in_image(degree)))
    if robot.calibration is not None and robot.calibration.is_stereo:
        found.append(_turned("the eyes are turned towards each other", robot.calibration, np.eye(3)[1:2]))
        found.append(_turned("the eyes are turned against each other", robot.calibration, np.eye(3)))
    return found


def _turned(what: str, calibration: StereoCalibration, axes: FloatArray) -> DiscrepancyFamily:
    """Return the family of the right camera rotated about some of its axes (a, 3)."""

    def moves(run: PipelineRun) -> FloatArray:
        return by_turn(run.measured, calibration, axes)

    def without(x: FloatArray, numbers: FloatArray) -> FloatArray:
        return correct(x, calibration, numbers @ axes)

    return DiscrepancyFamily(what, "place", None, (), False, moves, _one, is_specific=True, correct=without)


def _yielding_supports(run: PipelineRun, k: int) -> list[DiscrepancyFamily]:
    """Return families of a joint's support deflecting under the arm's weight: in any way, or by springs on its axes."""
    what = f"what carries {run.simulation.robot.joints[k]} gives under the arm's weight"
    found = [DiscrepancyFamily(what, "body", None, (), False, _link(k), loads) for loads in (_moments(k), _wrenches(k))]
    supports = run.simulation.gravity.in_support_frames(k)
    for T in (np.eye(4), *supports):
        found.append(
            DiscrepancyFamily(what, "body", None, (), False, _link_about(k, T), _own_loads(k, T), ties=np.eye(6))
        )
    # One torsional spring about all axes of a frame, without and with one linear spring along all of them.
    tilt, tilt_and_sink = np.repeat([[0.0], [1.0]], 3, axis=0), np.repeat(np.eye(2), 3, axis=0)
    for T, ties in product(supports if run.simulation.bears_weight else (), (tilt, tilt_and_sink)):
        moves, loads = _link_about(k, T), _own_loads(k, T)
        found.append(DiscrepancyFamily(what, "body", None, (), False, moves, loads, ties, is_specific=True))
    for T in map(_middle, supports if run.simulation.bears_weight else ()):
        if 2.0 * np.linalg.norm(T[:3, 3]) >= _Settings.shortest:
            moves, loads = _link_about(k, T), _own_loads(k, T)
            bend = np.array([[0.0, 0.0, 0.0, 1.0, 1.0, 0.0]]).T  # one spring about both axes across the link
            found.append(DiscrepancyFamily(what, "body", None, (), False, moves, loads, bend, is_specific=True))
    return found


def _middle(T_link_joint: FloatArray) -> FloatArray:
    """Return the pose (4, 4) of a joint's frame in a frame halfway along its link, whose third axis is along the link.

    A beam under an end moment acts as if hinged there: the rotation and shift of its end match a hinge's.
    """
    T, way = np.eye(4), T_link_joint[:3, 3]
    one, other = np.linalg.svd(way[None])[2][1:]
    R_middle_link = np.stack([one, other, np.cross(one, other)])
    T[:3, :3], T[:3, 3] = R_middle_link @ T_link_joint[:3, :3], 0.5 * R_middle_link @ way
    return T


def _joint(k: int) -> Columns:
    return lambda run: run.by_joint[:, :, [k]]


@cache
def _link(k: int) -> Columns:
    known: WeakKeyDictionary[PipelineRun, FloatArray] = WeakKeyDictionary()

    def moves(run: PipelineRun) -> FloatArray:
        if run not in known:
            robot = run.simulation.robot
            known[run] = run.columns(Effect.at(robot, "link_geometry", robot.joints[k]))
        return known[run]

    return moves


def _tool(run: PipelineRun) -> FloatArray:
    return run.columns(Effect.at(run.simulation.robot, "tool_offset"))


def _camera(run: PipelineRun) -> FloatArray:
    return run.columns(Effect.at(run.simulation.robot, "camera_pose"))


def _per_second_late(run: PipelineRun) -> FloatArray:
    """Return displacements per second of delay of the images."""
    return run.columns(Effect.at(run.simulation.robot, "camera_latency"))


def _anywhere(run: PipelineRun) -> FloatArray:
    return np.broadcast_to(np.eye(3), (len(run.motion), 3, 3))


def _in_depth(run: PipelineRun) -> FloatArray:
    """Return unit displacements along the ray on which the left camera sees the marker."""
    return run.measured[:, :, None]


def _along_axis(run: PipelineRun) -> FloatArray:
    """Return displacements by a shorter focal length: along the optical axis, in proportion to the distance."""
    return run.measured[:, 2:, None] * np.eye(3)[:, 2:]


def _any_of_joint(j: int) -> Columns:
    return lambda run: _with_one(np.concatenate([_trends(run, j), _harmonics(run, j, _Settings.harmonics)], axis=1))


def _any_of_both(k: int, j: int) -> Columns:
    def amounts(run: PipelineRun) -> FloatArray:
        of_one, of_other = _harmonics(run, k, 2), _harmonics(run, j, 2)
        both = of_one[:, :, None] * of_other[:, None, :]
        trends = np.concatenate([_trends(run, k), _trends(run, j), run.motion.q[:, [k]] * run.motion.q[:, [j]]], axis=1)
        return _with_one(np.concatenate([trends, of_one, of_other, both.reshape(len(both), -1)], axis=1))

    return amounts


def _any_of_time(count: int) -> Columns:
    """Return a constant and cosines (n, count + 1) over the time of the recording."""

    def amounts(run: PipelineRun) -> FloatArray:
        clock = run.motion.clock
        share = (clock - clock[0]) / max(float(clock[-1] - clock[0]), 1e-9)
        return np.cos(np.pi * share[:, None] * np.arange(count + 1))

    return amounts


def _shares_of_time(run: PipelineRun) -> FloatArray:
    """Return the time (n, 1), from -1/2 to 1/2: a constant delay is a named effect."""
    clock = run.motion.clock
    return (clock - clock[0])[:, None] / max(float(clock[-1] - clock[0]), 1e-9) - 0.5


def _waves_of_time(run: PipelineRun) -> FloatArray:
    """Return cosines (n, a) over the time of the recording, without a constant."""
    return _any_of_time(_Settings.times)(run)[:, 1:]


def _warming_or_any_of_time(run: PipelineRun) -> FloatArray:
    clock = run.motion.clock
    share = (clock - clock[0]) / max(float(clock[-1] - clock[0]), 1e-9)
    return np.concatenate(
        [_any_of_time(_Settings.times)(run), np.exp(-share[:, None] / np.array(_Settings.warming))], axis=1
    )


def _moments(k: int) -> Columns:
    return lambda run: _with_one(run.wrenches[:, k, :3])


def _wrenches(k: int) -> Columns:
    return lambda run: _with_one(run.wrenches[:, k])


def _link_about(k: int, T: FloatArray) -> Columns:
    """Return columns of the link before a joint, moved along and rotated about a frame with the joint at T (4, 4)."""

    def moves(run: PipelineRun) -> FloatArray:
        along, about = np.split(_link(k)(run) @ np.kron(np.eye(2), T[:3, :3].T), 2, axis=2)
        return np.concatenate([along, about + along @ -cross_matrix(T[:3, 3])], axis=2)

    return moves


def _own_loads(k: int, T: FloatArray) -> Columns:
    """Return force along and moment about each axis (n, 6) of a frame that has the joint at T (4, 4)."""

    def loads(run: PipelineRun) -> FloatArray:
        moments, forces = (part @ T[:3, :3].T for part in np.split(run.wrenches[:, k], 2, axis=1))
        return np.concatenate([forces, moments + np.cross(T[:3, 3], forces)], axis=1)

    return loads


def _places_in_image(degree: int) -> Columns:
    """Return monomials (n, b) up to a degree in image position and relative distance."""

    def amounts(run: PipelineRun) -> FloatArray:
        x = run.measured
        depth = np.where(np.abs(x[:, 2]) > 1e-3, x[:, 2], 1e-3)
        scale = float(np.median(np.abs(depth)))
        place = np.stack([x[:, 0] / depth, x[:, 1] / depth, depth / scale - 1.0], axis=1)
        chosen = [c for size in range(1, degree + 1) for c in combinations_with_replacement(range(3), size)]
        return _with_one(np.stack([place[:, c].prod(axis=1) for c in chosen], axis=1))

    return amounts


def _trends(run: PipelineRun, j: int) -> FloatArray:
    """Return a joint's reading and its square (n, 2)."""
    q = run.motion.q[:, [j]]
    return np.concatenate([q, np.square(q)], axis=1)


def _harmonics(run: PipelineRun, j: int, count: int) -> FloatArray:
    """Return sines and cosines (n, 2 count) of a joint's reading; a prismatic joint's range counts as half a turn."""
    q = run.motion.q[:, j]
    if run.simulation.robot.chain.prismatic[j]:
        q = np.pi * (q - q.min()) / max(float(np.ptp(q)), 1e-9)
    return np.concatenate([f(h * q)[:, None] for h in range(1, count + 1) for f in (np.sin, np.cos)], axis=1)


def _one(run: PipelineRun) -> FloatArray:
    return np.ones((len(run.motion), 1))


def _with_one(amounts: FloatArray) -> FloatArray:
    """Add a constant: a constant part of the error belongs to the same cause."""
    return np.concatenate([np.ones((len(amounts), 1)), amounts], axis=1)


def joints_of(family: DiscrepancyFamily, numbers: FloatArray, run: PipelineRun) -> frozenset[int]:
    """Return the erring joints and those that the error depends on, by their indices in q.

    Args:
        numbers: parameters of the family (p,).
    """
    own = frozenset[int]() if family.joint is None else frozenset({family.joint})
    if family.over_time:
        return own
    return own | frozenset(np.flatnonzero(shares(family, numbers, run) >= _Settings.shows).tolist())


def shares(family: DiscrepancyFamily, numbers: FloatArray, run: PipelineRun) -> FloatArray:
    """Return the share of the error's variance due to each joint, given the others (d,).

    It is half the mean square change if only this joint is taken from another row (Jansen 1999).

    Args:
        numbers: parameters of the family (p,).
    """
    rng = np.random.default_rng(0)
    amounts, moves = family.amounts(run), family.moves(run)
    low, high = amounts.min(axis=0), amounts.max(axis=0)
    margin = _Settings.beyond * (high - low) + 1e-12
    by = family.moved_by(run, numbers)
    # Keep each row's directions fixed: the leverage of a joint on the marker does not count.
    lengths = np.einsum("nia,nib->nab", moves, moves)
    variance = _mean_square(lengths, by - by.mean(axis=0))
    found = np.zeros(run.motion.q.shape[1])
    for k in range(len(found)):
        q = run.motion.q.copy()
        q[:, k] = rng.permutation(q[:, k])
        other = run.simulation.run(replace(run.motion, q=q))
        there = family.amounts(other)
        seen = ((there >= low - margin) & (there <= high + margin)).all(axis=1)
        change = (family.moved_by(other, numbers) - by)[seen]
        if seen.any():
            found[k] = 0.5 * _mean_square(lengths[seen], change) / max(variance, 1e-300)
    return found


def _mean_square(lengths: FloatArray, by: FloatArray) -> float:
    """Return the mean square displacement by moves (n, a) [m²]; `lengths` (n, a, a) are their products."""
    return float(np.einsum("na,nab,nb->n", by, lengths, by).mean())
