"""Findings about a learner for its user: camera and tool pose, sufficiency of the data, and problems."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bodyschema.calibration.chain_figures import ChainFigures, limited_to_exact_pairs, tolerances_determined
from bodyschema.calibration.plausibility.check import plausibility
from bodyschema.calibration.plausibility.search import SearchSettings
from bodyschema.calibration.plausibility.verdict import FEWEST_ROWS
from bodyschema.daemon.transport.status import UNDECIDED, Change
from bodyschema.interfaces.protocols import Clock
from bodyschema.learning.data_outlook import LearnerEvidence, ResidualScatter, forecast
from bodyschema.learning.model_bank import SOLVED
from bodyschema.learning.online_learner import OnlineLearner
from bodyschema.learning.solvers.tolerance_selection import ToleranceSettings, probable_indices
from bodyschema.learning.status import (
    JOINT,
    ChainCalibration,
    ChangeRecord,
    DataOutlook,
    JointZero,
    KindOfChange,
    LearntFigure,
)
from bodyschema.robot.calibrated_files import CAMERA_LINK
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainBelief, KBMapsError

log = logging.getLogger(__name__)


class _Settings:
    share: float = 10.0  # findings take at most 1/share of a processor, which the robots share, and recur no more often
    every_s: float = 1.0  # shortest interval between two findings of a robot
    min_probability: float = 0.01  # kinds less probable than this are not reported


class FindingsBudget:
    """Limiter of all users of the background thread together to 1/`share` of a processor. For that thread alone.

    Attributes:
        due_at: time of the next permitted finding.
        cpu_s: returns the thread's CPU time [s]. On a busy machine most of the wall time is waiting, and a rest of ten
            times as long would suppress findings for a quarter of an hour.
    """

    def __init__(self, cpu_s: Callable[[], float] = time.thread_time) -> None:
        self.due_at, self.cpu_s = -math.inf, cpu_s

    def record(self, begin: float, seconds: float) -> None:
        """Note that one finding took `seconds` from `begin` on."""
        self.due_at = begin + _Settings.share * seconds


class Findings:
    """Findings that are computed whenever there is a new chain, or another model answers.

    Only the background thread may compute them. Any thread may read the results.

    Attributes:
        data_problems: reasons to suspect that the pairs are of another robot: exchanged columns, reversed joints.
    """

    def __init__(
        self,
        learning: OnlineLearner,
        robot: RobotDescription,
        clock: Clock,
        robots: int = 1,  # number of robots that share the background thread
        budget: FindingsBudget | None = None,  # their common time limit
    ) -> None:
        self._learning, self._robot, self._clock = learning, robot, clock
        self._budget = budget or FindingsBudget()
        self._budget_divisor = _Settings.share * robots
        self._inputs_used: tuple[ChainBelief | None, str] = None, ""
        self._due_at = clock.now()
        self._found: tuple[ChainCalibration | None, DataOutlook | None] = None, None
        self._checked, self.data_problems = 0, ()

    @property
    def calibration(self) -> ChainCalibration | None:
        """Pose of camera and tool, and joint offsets; None before the first solution with the present tool."""
        return self._found[0] if self._learning.belief is not None else None

    @property
    def outlook(self) -> DataOutlook | None:
        """Expected gain of further pairs; None until a solution with the present tool answers."""
        answers = self._learning.belief is not None and self._learning.snapshot.answering in SOLVED
        return self._found[1] if answers else None

    @property
    def at_rest(self) -> bool:
        """True if the findings are up to date with the current chain and model."""
        return self._inputs_used == self._inputs

    @property
    def _inputs(self) -> tuple[ChainBelief | None, str]:
        return self._learning.belief, self._learning.snapshot.answering

    def renew(self) -> None:
        """Compute all findings again if their inputs have changed and the time limit permits."""
        self._check()
        begin, present = self._clock.now(), self._inputs
        if present[0] is None:
            self._inputs_used, self._found = present, (None, None)  # the findings belong to another tool
            return
        if present == self._inputs_used or begin < max(self._due_at, self._budget.due_at):
            return
        self._inputs_used, known, cpu_s = present, self._learning.known(), self._budget.cpu_s()
        if known is None:
            self._found = None, None
            return
        try:
            self._found = _found(self._robot, known)
        except (KBMapsError, np.linalg.LinAlgError) as error:
            log.warning("status has no calibration for now: %s", error)
            self._found = None, None
        seconds = self._budget.cpu_s() - cpu_s
        self._budget.record(begin, seconds)
        self._due_at = begin + max(self._budget_divisor * seconds, _Settings.every_s)

    def _check(self) -> None:
        """Check the pairs with the present tool once there are enough, and again whenever their number has doubled."""
        begin, count = self._clock.now(), self._learning.counters.since_change
        if count < self._checked:
            self._checked, self.data_problems = 0, ()
        if count < max(FEWEST_ROWS, 2 * self._checked) or begin < self._budget.due_at:
            return
        cpu_s = self._budget.cpu_s()
        q, x = self._learning.kept(SearchSettings.rows)
        if len(q) < FEWEST_ROWS:  # the others are doubted
            return
        self._checked = count
        self.data_problems = plausibility(self._robot, q, x, chain=self._learning.nominal.chain).sentences
        self._budget.record(begin, self._budget.cpu_s() - cpu_s)


def _found(robot: RobotDescription, known: LearnerEvidence) -> tuple[ChainCalibration, DataOutlook | None]:
    scatter = ResidualScatter.of(known)
    outlook = forecast(known, scatter, robot.joints) if known.solved else None
    return calibrated(robot, known, scatter), outlook


def calibrated(robot: RobotDescription, known: LearnerEvidence, scatter: ResidualScatter) -> ChainCalibration:
    """Return the chain in the terms of robot.toml."""
    found, workmanship = figures(robot, known)
    numbers = [
        LearntFigure(*(float(part) for part in parts))
        for parts in zip(found.drawn, found.drawn + found.moved, found.half_widths, strict=True)
    ]
    return ChainCalibration(
        pairs=known.pairs,
        camera_link=robot.camera.parent_link,
        camera_xyz=numbers[:3],
        camera_rpy=numbers[3:6],
        marker_link=robot.robot.marker_link,
        marker_xyz=numbers[6:9],
        zeros={
            name: JointZero(number.learnt, number.half_width) if shown else None
            for name, number, shown in zip(robot.joints, numbers[9:], found.shown, strict=True)
        },
        axes_rad=None if workmanship is None else workmanship[0],
        points_m=None if workmanship is None else workmanship[1],
        noise_m=scatter.noise_m,
        outliers=scatter.outliers,
        hand_eye=found.hand_eye(CAMERA_LINK),
        marker_covariance=found.covariance[6:9, 6:9].ravel().tolist(),
    )


def figures(robot: RobotDescription, known: LearnerEvidence) -> tuple[ChainFigures, tuple[float, float] | None]:
    """Return the figures, and the estimated manufacturing tolerances: 1-sigma of axis tilt [rad] and axis shift [m].

    The tolerances are None if the pairs do not determine them.

    With the learner's initial tolerances, an axis tilt could be mistaken for any joint offset. The pairs determine the
    tolerances, but seldom sharply, so the figures average over all probable tolerances.
    """
    wide = known.tolerances
    candidates = [(wide.axes, wide.points)]
    candidates += [
        (axes, points) for axes, points in ToleranceSettings.candidates if axes < wide.axes and points < wide.points
    ]
    prior = known.nominal.belief(known.wide.parameters.reference, wide)
    belief = limited_to_exact_pairs(known.wide, prior, robot)
    beliefs = [belief.tightened(wide, replace(wide, axes=axes, points=points)) for axes, points in candidates]
    kept, shares = probable_indices(np.array([evidence for _, evidence in beliefs]))
    is_determined = tolerances_determined([candidates[k] for k in kept])
    return ChainFigures(robot, tuple(beliefs[k][0] for k in kept), shares, prior), candidates[
        kept[0]
    ] if is_determined else None


class Changes:
    """Logger of the learner's changes, in the robot's names. Not thread-safe.

    Args:
        joints: joint names.
        change: the last change that was already reported, or None.
    """

    def __init__(self, joints: Sequence[str], change: ChangeRecord | None = None) -> None:
        self._joints, self._reported = tuple(joints), change

    def note(self, change: ChangeRecord | None, *, rolled_back: bool = False) -> None:
        """Log the news about the last change: its detection, its cause, its rollback."""
        previous, self._reported = self._reported, change
        if rolled_back:
            log.info(
                "rolled back to the model before %s",
                "the change" if previous is None else f"sample {previous.first_seq}",
            )
        elif change is not None and (previous is None or previous.noticed_seq != change.noticed_seq):
            log.info("%s", self._sentence(change))
        elif change is not None and previous is not None and self._name(previous) != self._name(change):
            log.info("the change at sample %d is %s", change.first_seq, self._name(change))

    def status(self, change: ChangeRecord | None, *, can_roll_back: bool) -> Change | None:
        """Return the change for the status; None: there was none."""
        if change is None:
            return None
        return Change(
            first_seq=change.first_seq,
            earliest_seq=change.earliest_seq,
            latest_seq=change.latest_seq,
            noticed_seq=change.noticed_seq,
            found=change.found,
            kind=self._name(change),
            probabilities={
                self._kind_name(kind): round(kind.probability, 3)
                for kind in change.kinds
                if kind.probability > _Settings.min_probability
            },
            alike=None if change.named is None else change.alike(change.named),
            moved_m=change.moved_m,
            can_roll_back=can_roll_back,
        )

    def _sentence(self, change: ChangeRecord) -> str:
        if not change.found:
            return f"tool changed before sample {change.first_seq}, as reported by the command tool_changed"
        moved = "" if change.moved_m is None else f", marker moved by {1e3 * change.moved_m:.1f} mm"
        return (
            f"change found at sample {change.first_seq} ({change.earliest_seq} to {change.latest_seq}, noticed at "
            f"{change.noticed_seq}): {self._name(change)}{moved}"
        )

    def _name(self, change: ChangeRecord) -> str:
        return UNDECIDED if change.named is None else self._kind_name(change.named)

    def _kind_name(self, kind: KindOfChange) -> str:
        return kind.name if kind.joint is None else f"{JOINT} {self._joints[kind.joint]}"
