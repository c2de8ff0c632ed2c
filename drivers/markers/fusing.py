"""Fuse the positions of several sources that see the same marker, and name those that disagree."""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from bodyschema.interfaces.errors import SourceEnded
from bodyschema.interfaces.protocols import Clock, MarkerSource
from bodyschema.interfaces.records import FloatArray, MarkerFix, MarkerMiss, Reason, frozen_array
from bodyschema.robot.rpy import rpy_of

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

log = logging.getLogger(__name__)


class _Settings:
    # of waiting for one source before the next is asked
    slice_s: float = 0.004
    # without a position from it, another source leads
    leads_for_s: float = 0.5
    # acceleration of a guided hand: bounds the error of linear interpolation
    hand_m_s2: float = 2.0
    # common positions for the verdict on a source
    judged: int = 300
    min_judged: int = 30
    # share of disagreeing positions that is reported; by chance it is 0.001
    many: float = 0.05
    # a rigid transform explains a disagreement that it brings below this multiple of the usual chi²
    well_fitted: float = 3.0
    # the positions have to span so much in two directions for the transform to be known
    spread_m: float = 0.02
    longest_wait_s: float = 0.1  # for the other sources' positions of the same time
    # between two positions that are interpolated: three frames at 30 Hz, of which one is missing
    longest_gap_s: float = 0.12
    fixes_kept: int = 64  # of each source


CHI2_999, CHI2_MEDIAN = 16.27, 2.37  # of 3 degrees of freedom


@dataclass(frozen=True, slots=True)
class PositionPair:
    """Positions of two sources at one time."""

    # lead, other: positions [m], (3,)
    lead: FloatArray
    other: FloatArray
    cov: FloatArray  # covariance of their difference [m²], (3, 3)

    @property
    def chi2(self) -> float:
        """Squared Mahalanobis distance of the two."""
        difference = self.other - self.lead
        return float(difference @ np.linalg.solve(self.cov, difference))


class Member:
    """One of several sources.

    Attributes:
        name: name in messages.
        pose: pose of the source's frame in the measurement frame, (4, 4).
        newest_t: time of its newest position or miss [s].
        common: its positions paired with those of the leading source.
    """

    def __init__(self, name: str, source: MarkerSource, pose: FloatArray) -> None:
        from scipy.spatial.transform import Rotation  # takes half a second, so not while positions arrive

        self.name, self.source, self.pose = name, source, pose
        self._turn = Rotation.from_matrix(pose[:3, :3])
        self.common: deque[PositionPair] = deque(maxlen=_Settings.judged)
        self.forget()

    def forget(self) -> None:
        self.fixes: deque[MarkerFix] = deque(maxlen=_Settings.fixes_kept)
        self.waiting: deque[tuple[MarkerFix, float]] = deque(maxlen=_Settings.fixes_kept)
        self.newest_t = self.fixed_at = -math.inf

    def take(self, seen: MarkerFix | MarkerMiss, now: float) -> None:
        """Store a position or a miss that arrived at `now` [s]."""
        self.newest_t = seen.t
        if isinstance(seen, MarkerFix):
            fix = _moved(seen, self.pose, self._turn)
            self.fixes.append(fix)
            self.waiting.append((fix, now))
            self.fixed_at = now

    def at(self, t: float, sigma_s: float) -> tuple[FloatArray, FloatArray] | None:
        """Return position [m] and covariance [m²] at time `t` [s], whose 1-sigma is `sigma_s`; None if unknown."""
        after = next((k for k, fix in enumerate(self.fixes) if fix.t >= t), 0)
        if after == 0:
            return None
        first, second = self.fixes[after - 1], self.fixes[after]
        gap_s = second.t - first.t
        if gap_s > _Settings.longest_gap_s:
            return None
        share = (t - first.t) / gap_s
        velocity = (second.x - first.x) / gap_s
        late_m = velocity * math.hypot(sigma_s, first.t_sigma, second.t_sigma)
        bend_m = 0.5 * _Settings.hand_m_s2 * share * (1 - share) * gap_s**2
        cov = (1 - share) ** 2 * first.cov + share**2 * second.cov + np.outer(late_m, late_m) + bend_m**2 * np.eye(3)
        return first.x + share * (second.x - first.x), cov

    def verdict(self, leader: str) -> str | None:
        """Describe the disagreement of its positions with the leader's, with the remedy; return None if they agree."""
        common = list(self.common)  # another thread may add to it
        if len(common) < _Settings.min_judged:
            return None
        chi2 = np.array([pair.chi2 for pair in common])
        share = float((chi2 > CHI2_999).mean())
        if share < _Settings.many:
            return None
        gap_m = float(np.median([np.linalg.norm(pair.other - pair.lead) for pair in common]))
        return (
            f"{leader} and {self.name} disagree in {100 * share:.0f} % of {len(chi2)} common positions, by "
            f"{1e3 * gap_m:.1f} mm in the median, which is {math.sqrt(float(np.median(chi2)) / CHI2_MEDIAN):.1f} times "
            f"what their uncertainties allow: {self._remedy(common)}"
        )

    def _remedy(self, common: Sequence[PositionPair]) -> str:
        lead, other = (np.array([getattr(pair, side) for pair in common]) for side in ("lead", "other"))
        T, spread = _rigid(other, lead)
        if spread < _Settings.spread_m:
            return "move the marker through the whole workspace; then this message says what would make them agree"
        fitted = [replace(pair, other=T[:3, :3] @ pair.other + T[:3, 3]).chi2 for pair in common]
        if float(np.median(fitted)) > _Settings.well_fitted * CHI2_MEDIAN:
            return (
                "one of them follows another marker, or its latency_s or sigma_m is wrong; look at each alone, with "
                "`bodyschema watch marker` and `bodyschema calibrate latency`"
            )
        pose = T @ self.pose
        xyz = ", ".join(f"{value:.4f}" for value in pose[:3, 3])
        rpy = ", ".join(f"{value:.4f}" for value in rpy_of(pose[:3, :3]))
        return (
            f"their frames differ; write xyz = [{xyz}] and rpy = [{rpy}] in the [[marker_source]] {self.name}, and "
            "start again"
        )


class FusedMarkers:
    """`MarkerSource` that fuses several sources with different frames and timestamps.

    The first source that sees the marker leads. The others' positions are interpolated to its times, and all are
    averaged with their full covariances as weights. If they contradict each other, there is no position.

    Attributes:
        members: the sources, in the order of preference.
    """

    def __init__(self, members: Sequence[Member], clock: Clock) -> None:
        self.members, self._clock = list(members), clock
        self._opened = ExitStack()
        self._last_t = -math.inf

    @property
    def health(self) -> tuple[str, ...]:
        """Disagreements between sources, with the remedy."""
        verdicts = (member.verdict(self.members[0].name) for member in self.members[1:])
        return tuple(verdict for verdict in verdicts if verdict is not None)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for member in self.members:
                stack.enter_context(member.source)
                member.forget()
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def read(self, timeout_s: float) -> MarkerFix | MarkerMiss | None:
        """Return the next fused position, or the reason for a missing one; see `MarkerSource.read`."""
        deadline = self._clock.now() + timeout_s
        while True:
            missed = self._read_all()
            found = self._next() or missed
            if found is not None and found.t > self._last_t:
                self._last_t = found.t
                return found
            if self._clock.now() >= deadline:
                return None

    def _read_all(self) -> MarkerMiss | None:
        """Read each source once; return a miss if none has seen the marker for a while."""
        missed: MarkerMiss | None = None
        ended = 0
        for member in self.members:
            try:
                seen = member.source.read(_Settings.slice_s)
            except SourceEnded:
                ended += 1
                continue
            if seen is not None:
                member.take(seen, self._clock.now())
            if isinstance(seen, MarkerMiss):
                missed = seen
        if ended == len(self.members):
            raise SourceEnded
        is_seen = any(self._clock.now() - member.fixed_at < _Settings.leads_for_s for member in self.members)
        return None if is_seen else missed

    def _next(self) -> MarkerFix | MarkerMiss | None:
        now = self._clock.now()
        seeing = [member for member in self.members if now - member.fixed_at < _Settings.leads_for_s]
        if not seeing:
            return None
        leader, *others = seeing
        for other in others:
            other.waiting.clear()
        while leader.waiting and leader.waiting[0][0].t <= self._last_t:
            leader.waiting.popleft()
        if not leader.waiting:
            return None
        fix, arrived = leader.waiting[0]
        if now - arrived < _Settings.longest_wait_s and any(other.newest_t < fix.t for other in others):
            return None
        leader.waiting.popleft()
        return self._fused(leader, fix, others)

    def _fused(self, leader: Member, fix: MarkerFix, others: Sequence[Member]) -> MarkerFix | MarkerMiss:
        found = [(fix.x, fix.cov)]
        for other in others:
            at = other.at(fix.t, fix.t_sigma)
            if at is None:
                continue
            if leader is self.members[0]:
                other.common.append(PositionPair(fix.x, at[0], fix.cov + at[1]))
            found.append(at)
        consistent = _consistent(found)
        if not consistent:
            return MarkerMiss(fix.t, Reason.DISAGREEING)
        if len(found) == 1:
            return fix
        x, cov = _mean(consistent)
        return replace(fix, x=frozen_array(x), cov=frozen_array(cov), centres_px=None)


Positions = list[tuple[FloatArray, FloatArray]]


def _consistent(found: Positions) -> Positions:
    """Return the positions that agree with the mean of the others, after removing the worst until all do.

    Return nothing if no two agree.
    """
    remaining = list(found)
    while len(remaining) > 1:
        chi2 = []
        for place, (x, cov) in enumerate(remaining):
            mean, of_mean = _mean(remaining[:place] + remaining[place + 1 :])
            chi2.append(PositionPair(mean, x, cov + of_mean).chi2)
        worst = int(np.argmax(chi2))
        if chi2[worst] < CHI2_999:
            return remaining
        del remaining[worst]
    return remaining if len(found) == 1 else []


def _mean(found: Positions) -> tuple[FloatArray, FloatArray]:
    """Return the mean of positions weighted by their inverse covariances, and its covariance."""
    informations = [np.linalg.inv(cov) for _, cov in found]
    cov = np.linalg.inv(sum(informations, np.zeros((3, 3))))
    total = sum((weight @ x for weight, (x, _) in zip(informations, found, strict=True)), np.zeros(3))
    return cov @ total, 0.5 * (cov + cov.T)


def _rigid(points: FloatArray, targets: FloatArray) -> tuple[FloatArray, float]:
    """Return the rigid transform (4, 4) of points (n, 3) onto targets, and their second largest RMS spread [m]."""
    mean, mean_target = points.mean(axis=0), targets.mean(axis=0)
    u, s, vt = np.linalg.svd((targets - mean_target).T @ (points - mean))
    T = np.eye(4)
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    T[:3, 3] = mean_target - T[:3, :3] @ mean
    return T, math.sqrt(s[1] / len(points))


def _moved(fix: MarkerFix, pose: FloatArray, rotation: Rotation) -> MarkerFix:
    """Return the fix transformed by `pose` (4, 4), the pose of its frame in the target frame, and its `rotation`."""
    if np.array_equal(pose, np.eye(4)):
        return fix
    R = pose[:3, :3]
    x, cov = frozen_array(R @ fix.x + pose[:3, 3]), frozen_array(R @ fix.cov @ R.T)
    turn = None if fix.R is None else frozen_array((rotation * rotation.from_quat(fix.R)).as_quat())
    cov_turn = None if fix.cov_R is None else frozen_array(R @ fix.cov_R @ R.T)
    return replace(fix, x=x, cov=cov, R=turn, cov_R=cov_turn, centres_px=None)
