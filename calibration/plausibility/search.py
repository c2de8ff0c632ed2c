"""Search for the reading of the columns with which the pairs fit the nominal links."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainParameters, DegenerateDataError, RigidChain, align
from kbmaps.chains.placement import Placements, place
from kbmaps.rotations import rotation_vectors

from .limits import LimitSettings, spread_m
from .reading import QUARTER, Reading
from .size import log_evidences
from .verdict import THRESHOLDS


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses that are far from each other, and the rows near each."""

    rows: NDArray[np.intp]  # the row of each pose (k,)
    of_rows: NDArray[np.intp]  # index of the nearest pose for each row (n,)

    @classmethod
    def of(cls, chain: RigidChain, q: FloatArray) -> Poses:
        """Choose poses of rows q (n, d) [rad, m] that are apart in at least one joint."""
        q = q / np.where(chain.prismatic, LimitSettings.a_radian_m, 1.0)
        distances = np.abs(q[:, None] - q).max(axis=2)
        kept: list[int] = []
        for row, far in enumerate(distances > SearchSettings.apart_rad):
            if far[kept].all():
                kept.append(row)
        return cls(np.array(kept, dtype=np.intp), distances[:, kept].argmin(axis=1))

    def mean(self, values: ArrayLike) -> float:
        """Return the mean of values (n,) of the rows, each pose counted once."""
        return float((np.bincount(self.of_rows, values) / np.bincount(self.of_rows)).mean())

    def evidence_gain(self, gain: float, joints: int, share: float = 1.0) -> float:
        """Return the evidence for a reading over another one, each placed by these rows [nats].

        Any reading fits as many coordinates as there are offsets of joints, camera and marker.

        Args:
            gain: logarithm of the ratio of their distances.
            share: fraction of the rows used to measure the distances.
        """
        return gain * max(3.0 * share * len(self.rows) - joints - 9.0, 0.0)


class SearchSettings:
    # Width and depth of the search over readings: offsets of up to four joints by a quarter turn are found.
    width: int = 4
    depth: int = 5
    # Readings whose errors differ by less count as one: offsets of the first and of the last joint make no difference.
    same_error: float = 0.005
    # The search ends at a fit with these shares of the positions' spread: of the columns as they are, and read
    # otherwise.
    enough_unchanged: float = 0.03
    enough: float = 0.01
    # A reading is more probable by this much [nats], less a penalty for each change of the reading.
    min_evidence: float = 10.0
    change_penalty: float = 3.0
    # A joint offset above this is mentioned: that of one in 300 generated arms with offsets of up to 10°.
    far_zero_rad: float = math.radians(20.0)
    near_zero_rad: float = far_zero_rad / 2.0  # ... unless the pairs fit about as well with half of it.
    held: float = 1e-3  # share of its tolerance that is left to a joint offset that is held
    # A zero of the last joint this far off is not fitted where the marker is known: its quarter turns are tried
    # instead.
    last_zero_rad: float = math.radians(3.0)
    # ... and named where the known marker comes out so many times nearer to its place: with 3, 2 of 32 markers that
    # were 50 mm off in each direction (1-sigma) came out so by chance.
    nearer: float = 5.0
    parallel: float = 0.999  # Axes are parallel if the cosine between them is above this: 2.6°
    listed: int = 2  # maximum number of other, equally good readings that are listed
    # Rows within this distance, of the joint that moved farthest, are of one pose: along a path the errors of links
    # change slowly.
    apart_rad = math.radians(10.0)
    # Number of rows to be read in other ways, evenly spread. Twice as many cost twice the time and change no verdict of
    # the tests.
    rows: int = 80


@dataclass(frozen=True, slots=True)
class ReadingFit:
    """Quality of a reading's fit."""

    error: float  # RMS distance of the nearest pairs, in the recording's own unit
    neg_log_posterior: float  # minus the log-likelihood, including the cost of offsets and marker
    zeros: FloatArray  # added to the joints (d,) beside the quarter turns [rad, m]
    tool_m: float  # distance of the marker from its place [m]
    rotation: FloatArray  # of the nominal measurement frame in the real one (3, 3)


class ReadingSearch:
    """Search over readings of the same pairs, with their fits.

    Args:
        q, x: rows to be read, (n, d) [rad, m] and (n, 3) [m].
        exact_m: distances below this are not distinguished [m].
        pose_known: True if the camera pose is known.
    """

    def __init__(self, chain: RigidChain, q: FloatArray, x: FloatArray, exact_m: float, pose_known: bool) -> None:
        self.chain, self.q, self.x, self.exact_m, self._pose_known = chain, q, x, exact_m, pose_known
        self._parameters = ChainParameters(chain)
        self._std = np.where(chain.prismatic, LimitSettings.slides_m, LimitSettings.zeros_rad)
        self.poses = Poses.of(chain, q)
        self._tried: set[Reading] = set()
        self.fits: dict[Reading, ReadingFit] = {}  # the best fit of each reading so far

    def verdict(self) -> tuple[Reading, Reading, list[Reading]]:
        """Return the unchanged columns, the simplest reading among the best, and others nearly as simple."""
        unchanged = Reading.plain(self.chain.joints)
        slides: list[bool] = self.chain.prismatic.tolist()
        self._try([unchanged, *unchanged.neighbours(slides), *self.carrying()])
        if self._best()[0] != unchanged:
            # With a marker far from nominal, the fit of the right reading may have ended in a local minimum.
            self._fit([unchanged] * 6, tools=LimitSettings.tool_m * np.concatenate([np.eye(3), -np.eye(3)]))
        expanded, spread = [unchanged], spread_m(self.x)
        for depth in range(1, SearchSettings.depth):
            best = self._best()[0]
            left = self.fits[best].error / spread
            if best in expanded and (
                left < SearchSettings.enough
                or (best == unchanged and (left < SearchSettings.enough_unchanged or depth > 1))
            ):
                break
            new = self._distinct(expanded)
            expanded += new
            if depth == 1:
                self._try(unchanged.doubles(slides))
            self._try(other for reading in new for other in reading.neighbours(slides))
        best = self._best()[0]
        enough = SearchSettings.enough_unchanged if best == unchanged else SearchSettings.enough
        if self.fits[best].error > enough * spread:
            self._try(unchanged.mixed(slides))
        best = self._best()[0]
        if not nameable(best, self.fits[best], spread):
            self._fit([unchanged], tools=self._aligned_tool())
            self._try(unchanged.mixed_exchanges(slides))
            self._try(other for reading in self._distinct(expanded) for other in reading.neighbours(slides))
        if unchanged not in self.fits:
            self._fit([unchanged], held=True)
        best, refuted = self._most_probable(unchanged)
        good = sorted(
            (
                reading
                for reading, fit in self.fits.items()
                if self._fits_as_well(fit, self.fits[best]) and not self._is_close_to_any(fit.error, refuted)
            ),
            key=lambda reading: (
                reading.changes,
                reading.quarters != unchanged.quarters,
                self.fits[reading].neg_log_posterior,
            ),
        )
        others = [reading for reading in good[1:] if reading.changes <= good[0].changes + 1]
        return unchanged, good[0], others[: SearchSettings.listed]

    def carrying(self) -> list[Reading]:
        """Return the readings in which a joint's column includes, or lacks, a parallel joint before it."""
        axes, turns = self.chain.axes, self.chain.fixed[1:-1, :3, :3]
        along = np.einsum("ki,kij,kj->k", axes[:-1], turns, axes[1:])
        rigid = self.chain.prismatic[:-1] | self.chain.prismatic[1:]
        parallel = np.flatnonzero(~rigid & (np.abs(along) > SearchSettings.parallel)) + 1
        plain = Reading.plain(self.chain.joints)
        return [reading for joint in parallel.tolist() for reading in plain.carrying(joint)]

    def _aligned_tool(self) -> FloatArray:
        """Return the marker's offset (1, 3) [m] with nominal joint offsets; its fit starts from many places."""
        try:
            return align(self.chain, self.q, self.x, pose_known=False, marker_known=False).marker_shift[None]
        except DegenerateDataError:
            return np.zeros((1, 3))

    def has_far_zero(self, joint: int, fit: ReadingFit) -> bool:
        """Return True if a joint's offset in `fit` is large, and a smaller one fits the columns clearly worse."""
        if self.chain.prismatic[joint] or abs(fit.zeros[joint]) <= SearchSettings.far_zero_rad:
            return False
        q, here = self.q.copy(), np.arange(self.chain.joints) == joint
        q[:, joint] += math.copysign(SearchSettings.near_zero_rad, fit.zeros[joint])
        held = place(
            self.chain,
            q[None],
            self.x[None],
            zeros_std=np.where(here, SearchSettings.held, 1.0) * self._std,
            tool_std=LimitSettings.tool_m,
        )
        ratio = max(float(held.errors(LimitSettings.measured_share)[0]), self.exact_m) / fit.error
        return ratio > THRESHOLDS.much_better and self.is_certain(math.log(ratio), LimitSettings.measured_share)

    def errors(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """Return the distances (s,) [m] of sets of pairs q (s, n, d) and x (s, n, 3), with unchanged columns."""
        placed = place(self.chain, q, x, zeros_std=self._std, tool_std=LimitSettings.tool_m)
        return np.maximum(placed.errors(LimitSettings.measured_share), self.exact_m)

    def distances(self, q: FloatArray, x: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Return the distances (s, n) [m] of sets of pairs from the arm placed by pairs q (n, d) and x (n, 3)."""
        placed = place(self.chain, q[None], x[None], zeros_std=self._std, tool_std=LimitSettings.tool_m)
        p = self._parameters
        change = np.zeros(p.size)
        change[p.zeros], change[p.tool] = placed.zeros[0], placed.tools[0]
        predicted = (p.positions(change, each) @ placed.rotations[0].T + placed.shifts[0] for each, _ in pairs)
        return np.stack([np.linalg.norm(at - seen, axis=1) for at, (_, seen) in zip(predicted, pairs, strict=True)])

    def is_certain(self, gain: float, share: float = 1.0) -> bool:
        """Return True if the poses are evidence enough for a reading that fits better; see `Poses.evidence_gain`."""
        return self.poses.evidence_gain(gain, self.chain.joints, share) > SearchSettings.min_evidence

    def place_rows(self, rows: NDArray[np.intp]) -> Placements:
        """Place the nominal chain to sets of rows (s, n), with unchanged columns."""
        return place(self.chain, self.q[rows], self.x[rows], zeros_std=self._std, tool_std=LimitSettings.tool_m)

    def offsets_on_hand(self, placed: Placements, one: int) -> FloatArray:
        """Return positions (n, 3) [m] relative to the marker, along the axes of its frame, by one of the placements."""
        p = self._parameters
        change = np.zeros(p.size)
        change[p.zeros], change[p.tool] = placed.zeros[one], placed.tools[one]
        x, jacobian = p.linearised(change, self.q)
        off = (self.x - placed.shifts[one]) @ placed.rotations[one] - x
        return np.einsum("nij,ni->nj", jacobian[:, :, p.tool], off)

    def with_marker_known(self, reading: Reading) -> tuple[Reading, ReadingFit] | None:
        """Return the reading with an offset near the hand off by quarter turns, and its fit, if the marker shows it.

        With a free marker position such a rotation makes no difference.
        """
        if self.chain.prismatic[-1]:
            return None
        last = np.arange(self.chain.joints) == self.chain.joints - 1
        std = np.where(last, SearchSettings.last_zero_rad, self._std)
        turned = [reading.turned((turns * last).tolist()) for turns in (0, 1, -1, 2)] + self._equivalent_turns(reading)
        fits = self._placed(turned, std=std, tool_m=LimitSettings.known_tool_m)
        nominal_fit = fits.pop(reading, None)
        best = min(
            fits,
            key=lambda each: fits[each].neg_log_posterior + SearchSettings.change_penalty * each.changes,
            default=reading,
        )
        if best not in turned or best == reading:
            return None
        fit = fits[best]
        # Without a fit, the known marker itself has led from this reading to another one.
        is_clear = (
            nominal_fit is None or fit.neg_log_posterior + SearchSettings.min_evidence < nominal_fit.neg_log_posterior
        )
        far = SearchSettings.nearer * fit.tool_m < (nominal_fit or self.fits[reading]).tool_m
        return (best, fit) if is_clear and far else None

    def with_marker_nearer(self, reading: Reading) -> Reading | None:
        """Return the reading with other quarter turns and as good a fit that brings a distant marker near its place."""
        best = min(self._equivalent_turns(reading), key=lambda each: self.fits[each].tool_m, default=reading)
        far = self.fits[reading].tool_m > SearchSettings.nearer * max(
            self.fits[best].tool_m, LimitSettings.known_tool_m
        )
        return best if far else None

    def _equivalent_turns(self, reading: Reading) -> list[Reading]:
        """Return the readings with other quarter turns that fit as well."""
        return [
            other
            for other, fit in self.fits.items()
            if other != reading
            and replace(other, quarters=reading.quarters) == reading
            and self._fits_as_well(fit, self.fits[reading])
        ]

    def undirected(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the joints whose sign makes no difference in any row, since some joints may move in few rows only."""
        plain, slides = Reading.plain(len(names)), self.chain.prismatic
        readings = list(itertools.islice(plain.neighbours(slides.tolist()), len(names)))
        sign_is_free = [
            self._fits_as_well(self.fits[one], self.fits[plain]) if one in self.fits else False for one in readings
        ]
        if not any(sign_is_free):
            return ()
        own_error, *others = (
            self._rms_of_all_rows(one) if free else np.inf
            for one, free in zip([plain, *readings], [True, *sign_is_free], strict=True)
        )
        return tuple(
            name for name, error in zip(names, others, strict=True) if error < THRESHOLDS.much_better * own_error
        )

    def _rms_of_all_rows(self, reading: Reading) -> float:
        """Return the RMS distance [m] of all rows, outliers included."""
        q, x = reading.angles(self.q, self.chain.prismatic), reading.positions(self.x)
        return max(float(np.sqrt(np.square(self.distances(q, x, [(q, x)])).mean())), self.exact_m)

    def _best(self) -> list[Reading]:
        return sorted(
            self.fits,
            key=lambda reading: self.fits[reading].neg_log_posterior + SearchSettings.change_penalty * reading.changes,
        )

    def _most_probable(self, unchanged: Reading) -> tuple[Reading, list[float]]:
        """Return the most probable reading for links with tolerances, and the errors of better fits that it refutes.

        With nominal links a wrong reading may fit better, because its marker and joint offsets compensate errors of the
        links. This is only possible if the unchanged columns place the arm. These may themselves be the wrong reading
        that fits better.
        """
        candidates, spread = self._distinct([]), spread_m(self.x)
        own = self.fits.get(unchanged)
        if own is None or own.error >= THRESHOLDS.named * spread:
            return candidates[0], []
        nearest = candidates[0]
        if nearest == unchanged:
            candidates = [each for each in candidates if nameable(each, self.fits[each], spread)]
        candidates += [unchanged] if unchanged not in candidates else []
        if candidates == [unchanged]:
            return unchanged, []
        slides = self.chain.prismatic
        read = [(each.angles(self.q, slides), each.positions(self.x), each.scale) for each in candidates]
        changes = np.array([reading.changes for reading in candidates])
        log_probabilities = log_evidences(self.chain, read, self.poses.rows) - SearchSettings.change_penalty * changes
        # If the unchanged columns fit best, another reading needs twice the usual certainty.
        log_probabilities[candidates.index(unchanged)] += (
            2.0 * SearchSettings.min_evidence if nearest == unchanged else 0.0
        )
        best = candidates[int(log_probabilities.argmax())]
        neg_log_posterior, error = self.fits[best].neg_log_posterior, self.fits[best].error
        fits = [self.fits[reading] for reading in candidates]
        return best, [
            fit.error
            for fit in fits
            if fit.neg_log_posterior < neg_log_posterior and not self._is_close_to_any(error, [fit.error])
        ]

    @staticmethod
    def _is_close_to_any(error: float, others: list[float]) -> bool:
        return any(abs(error - other) <= SearchSettings.same_error * other for other in others)

    def _distinct(self, expanded: list[Reading]) -> list[Reading]:
        """Return the best readings whose fits differ from those already expanded, and from each other."""
        seen, new = [self.fits[reading].error for reading in expanded if reading in self.fits], list[Reading]()
        for reading in self._best():
            error = self.fits[reading].error
            if not self._is_close_to_any(error, seen):
                new.append(reading)
                seen.append(error)
            if len(new) == SearchSettings.width:
                break
        return new

    @staticmethod
    def _fits_as_well(fit: ReadingFit, best: ReadingFit) -> bool:
        return (
            fit.neg_log_posterior < best.neg_log_posterior + SearchSettings.min_evidence
            or fit.error < THRESHOLDS.as_good * best.error
        )

    def _try(self, readings: Iterable[Reading]) -> None:
        new = [reading for reading in dict.fromkeys(readings) if reading not in self._tried]
        self._tried.update(new)
        if new:
            self._fit(new)

    def _fit(self, new: list[Reading], *, held: bool = False, tools: FloatArray | None = None) -> None:
        """Fit readings, and keep the best fit of each.

        Args:
            tools: marker offsets (s, 3) [m] to start from.
        """
        std = self._std * (SearchSettings.held if held else 1.0)
        for reading, fit in self._placed(new, std=std, tools=tools).items():
            if reading not in self.fits or fit.neg_log_posterior < self.fits[reading].neg_log_posterior:
                self.fits[reading] = fit

    def _placed(
        self,
        new: list[Reading],
        *,
        std: FloatArray,
        tool_m: float = LimitSettings.tool_m,
        tools: FloatArray | None = None,
    ) -> dict[Reading, ReadingFit]:
        """Return the best fit of each reading; an offset that reaches the next quarter turn makes it another reading.

        Args:
            std: 1-sigma of each offset (d,) [rad, m].
            tool_m: 1-sigma of a coordinate of the marker [m].
            tools: displacements of the marker (s, 3) [m] to start from.
        """
        slides = self.chain.prismatic
        q = np.stack([reading.angles(self.q, slides) for reading in new])
        x = np.stack([reading.positions(self.x) for reading in new])
        placed = place(self.chain, q, x, zeros_std=std, tool_std=tool_m, tools=tools)
        quarters = np.where(slides, 0, np.rint(placed.zeros / QUARTER)).astype(np.intp)
        zeros = placed.zeros - QUARTER * quarters
        errors = np.maximum(placed.errors(LimitSettings.measured_share), self.exact_m) * [
            reading.scale for reading in new
        ]
        moved = np.linalg.norm(placed.tools, axis=1)
        cost = 0.5 * np.square(zeros / std).sum(axis=1) + 0.5 * np.square(moved / tool_m)
        if self._pose_known:
            turns = np.linalg.norm(rotation_vectors(placed.rotations), axis=1)
            cost += [
                0.0 if r.mirrored else 0.5 * (turn / THRESHOLDS.turned_rad) ** 2
                for r, turn in zip(new, turns, strict=True)
            ]
        neg_log_posterior = 3.0 * LimitSettings.measured_share * len(self.poses.rows) * np.log(errors) + cost
        fits: dict[Reading, ReadingFit] = {}
        for k, reading in enumerate(new):
            found = reading.turned(quarters[k].tolist())
            fit = ReadingFit(
                float(errors[k]), float(neg_log_posterior[k]), zeros[k], float(moved[k]), placed.rotations[k]
            )
            if found not in fits or fit.neg_log_posterior < fits[found].neg_log_posterior:
                fits[found] = fit
        return fits


def nameable(reading: Reading, fit: ReadingFit, spread: float) -> bool:
    """Return True if a fit is better than that of any wrong reading with the same number of changes."""
    return fit.error < THRESHOLDS.named / (1 + reading.changes) * spread
