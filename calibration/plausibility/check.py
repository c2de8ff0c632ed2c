"""Check that a recording can be of this robot, before any fit of it is trusted.

A rigid chain with free links fits a recording with a flipped joint or an offset of 90° as well as the right one: its
links are then nonsense. So the links are kept at nominal. The pose of the camera, the marker and the joint offsets are
fitted to many ways to read the columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, DegenerateDataError, RigidChain, align
from kbmaps.chains.placement import place
from kbmaps.rotations import rotation_vector, rotation_vectors

from .limits import A_RADIAN_M, KNOWN_TOOL_M, MEASURED, SLIDES_M, TOOL_M, ZEROS_RAD, reach_m, spread_m
from .reading import AS_IT_IS, QUARTER, REMEDIES, Reading, errors_rad
from .size import evidences, size_of

# Number of rows to be read in other ways, evenly spread. Twice as many cost twice the time and change no verdict of the
# tests.
ROWS = 80
# With fewer rows nothing is refused: a wrong reading may fit by chance.
FEWEST_ROWS = 40


@dataclass(frozen=True)
class _Settings:
    """Settings of the search for another reading of the columns."""

    # Width and depth of the search over readings: offsets of up to four joints by a quarter turn are found.
    width: int = 4
    depth: int = 5
    # Readings whose errors differ by less count as one: offsets of the first and of the last joint make no difference.
    same: float = 0.005
    # The search ends at a fit with these shares of the positions' spread: of the columns as they are, and read
    # otherwise.
    enough_as_it_is: float = 0.03
    enough: float = 0.01
    # Another reading is reported if the pairs fit this many times better, and mentioned from `as_good` times on. Arms
    # with tolerances of 0.5° and 1 mm, offsets of 10° and noise of 10 mm stay below 1.15 with all wrong readings.
    much_better: float = 1.5
    as_good: float = 1.15
    # ... and if it is more probable by this much [nats], less a penalty for each change of the reading.
    certain: float = 10.0
    a_change: float = 3.0
    # Rows on the way from one pose to another say together what one says: errors of links change slowly along a path.
    # They count as one within this distance, of the joint that moved farthest.
    apart_rad: float = math.radians(10.0)
    # A fit with residuals above these shares of the positions' spread and of the arm's reach is not of this arm.
    unexplained: float = 0.25
    of_reach: float = 0.02
    # ... and above this multiple of the known noise.
    noises: float = 5.0
    # A reading with one change is reported if it leaves at most half of this share of the spread, with two a third, and
    # so on. Right readings of real arms leave up to 0.032, wrong ones down to 0.03 with four changes and 0.09 with two.
    named: float = 0.12
    # A joint offset above this is mentioned: that of one in 300 generated arms with offsets of up to 10°.
    far_zero_rad: float = math.radians(20.0)
    # ... unless the pairs fit about as well with half of it.
    near_zero_rad: float = far_zero_rad / 2.0
    # A known camera pose is not off by this much.
    turned_rad: float = math.radians(30.0)
    # A position belongs to the angles of a row this near at most: logs joined by row number lose one or two.
    near_rows: int = 3
    # Positions of another size are reported if it is off by this many times its own uncertainty. Right recordings of
    # real and generated arms come to 4.0, and fit hardly better for it.
    far_size: float = 5.0
    # Smaller ones are warned of: a joint whose ratio is 2 % off looks like positions 2.4 % off.
    other_size: float = 0.04
    # Orientations of a tag on a nominal arm are no better than this.
    oriented_rad: float = math.radians(1.0)
    # Rows are shifted if this share of them fits so many times better with angles or positions of the row as far away.
    # Up to 0.09 do so in right recordings, 0.16 and more where a fifth of the rows of a real recording is shifted.
    shifted: float = 0.12
    shifted_better: float = 5.0
    # Share of its tolerance that is left to a joint offset that is held.
    held: float = 1e-3
    # A zero of the last joint this far off is not fitted where the marker is known: its quarter turns are tried
    # instead.
    last_zero_rad: float = math.radians(3.0)
    # ... and named where the known marker comes out so many times nearer to its place: with 3, 2 of 32 markers that
    # were 50 mm off in each direction (1-sigma) came out so by chance.
    nearer: float = 5.0
    # Maximum number of other, equally good readings that are listed.
    listed: int = 2
    # Distances below this share of the reach are not distinguished.
    exact: float = 1e-5


_SETTINGS = _Settings()


@dataclass(frozen=True, slots=True)
class Plausibility:
    """Result of the plausibility check.

    Attributes:
        refusal: why the recording cannot be of this robot as it is, or None.
        remedy: what to do about that.
        misread: another reading of the columns was found that fits.
        warnings: sentences about possible problems.
        undirected: joints whose sign these pairs do not determine.
    """

    refusal: str | None = None
    remedy: str = ""
    misread: bool = False
    warnings: tuple[str, ...] = ()
    undirected: tuple[str, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """All problems and warnings as sentences."""
        refused = () if self.refusal is None else (f"{self.refusal}. {self.remedy}",)
        return tuple(f"{text[0].upper()}{text[1:]}." for text in (*refused, *self.warnings))

    def require(self, file: Path | str, *, force: bool) -> tuple[str, ...]:
        """Return the warnings for a recording that is fitted.

        Args:
            file: the recording's file.
            force: fit what would be refused.

        Raises:
            RecordingError: it cannot be of this robot as it is.
        """
        if self.refusal is not None and not force:
            raise RecordingError(self.refusal, file=file, remedy=f"{self.remedy}. Or fit it as it is with --force")
        return self.sentences


@dataclass(frozen=True, slots=True)
class _Fit:
    """Quality of a reading's fit.

    Attributes:
        error: RMS distance of the nearest pairs, in the recording's own unit.
        nats: minus the log-likelihood, what zeros and marker cost included.
        zeros: added to the joints (d,) beside the quarter turns [rad, m].
        tool_m: how far from its place the marker is [m].
        rotation: of the nominal measurement frame in the real one (3, 3).
    """

    error: float
    nats: float
    zeros: FloatArray
    tool_m: float
    rotation: FloatArray


def told_sigma(recording: Recording) -> float | None:
    """Return the 1-sigma of a coordinate [m], if the recording has it."""
    if recording.cov is None:
        return None
    return float(np.sqrt(np.trace(recording.cov, axis1=1, axis2=2).mean() / 3.0))


def plausibility(
    robot: RobotDescription,
    q: FloatArray,
    x: FloatArray,
    *,
    chain: RigidChain | None = None,
    sigma_m: float | None = None,
    orientation: FloatArray | None = None,
) -> Plausibility:
    """Check pairs q (n, d) [rad, m] and x (n, 3) [m] before a fit to them is trusted.

    Args:
        robot: the robot's description.
        q: joint values (n, d) [rad, m].
        x: positions (n, 3) [m].
        chain: the nominal chain if it is not the robot's.
        sigma_m: 1-sigma of a coordinate [m] if known.
        orientation: of the marker, quaternions x, y, z, w (n, 4), if known.
    """
    chain = chain or robot.chain
    reach, spread = reach_m(robot), spread_m(x)
    if 3 * len(q) < 2 * (chain.joints + 9) or spread < _SETTINGS.exact * reach:
        return Plausibility()
    rows = np.unique(np.linspace(0, len(q) - 1, ROWS).astype(np.intp))
    search = _Search(chain, q[rows], x[rows], _SETTINGS.exact * reach, robot.camera.pose_known)
    as_it_is, chosen, others = search.verdict()
    fit, names = search.fits[chosen], robot.joints
    before, after = search.fits[as_it_is].error, fit.error / chosen.scale
    unnamed = not (_nameable(as_it_is, search.fits[as_it_is], spread) or _nameable(chosen, fit, spread))
    if unnamed and len(q) >= FEWEST_ROWS:
        all_shifted = _shifted(search, q, x, before)
        if all_shifted is not None:
            return all_shifted
    noise = 0.0 if sigma_m is None else _SETTINGS.noises * sigma_m
    misread = chosen != as_it_is and before > _SETTINGS.much_better * fit.error and _nameable(chosen, fit, spread)
    fits = before < _SETTINGS.named * spread
    sized = (
        (None if misread else _partly_shifted(search, q, x, fits=fits))
        or search.sized(before, fit.error)
        or Plausibility()
    )
    if sized.refusal is not None:
        return _decided(sized, len(q))
    if before <= _SETTINGS.much_better * fit.error and not _nameable(chosen, fit, spread):
        chosen, fit, after = as_it_is, search.fits[as_it_is], before
    held = search.with_marker_known(chosen) if robot.robot.marker_known else None
    if held is not None and chosen != as_it_is:
        chosen, fit = held[0], held[1]
    unexplained = after > max(_SETTINGS.unexplained * spread / chosen.scale, _SETTINGS.of_reach * reach, noise)
    if unexplained or (chosen != as_it_is and not _nameable(chosen, fit, spread) and after > noise):
        looks = "" if chosen == as_it_is else chosen.looks(names, fit.zeros)
        found = _hardly(_mm(before), _mm(after), looks)
    elif chosen != as_it_is:
        frame = _frame(fit.rotation, True) if robot.camera.pose_known and chosen.mirrored else ""
        fits = f"the pairs then fit to {_mm(after)}, and as they are to {_mm(before)}"
        text = f"{chosen.looks(names, fit.zeros)}{frame}: {fits}"
        if after > before:
            text = (
                f"{text}, but with links that are off by as much as those of arms this is more probable. Check it on "
                "the arm before you use the model"
            )
        either = "; or ".join(other.looks(names, search.fits[other].zeros) for other in others)
        either = f". These pairs fit as well if {either}" if others else ""
        if before > _SETTINGS.much_better * fit.error:
            found = Plausibility(f"it seems that {text}", chosen.remedy(names, fit.zeros) + either, misread=True)
        else:
            found = Plausibility(warnings=(f"perhaps {text}{either}",))
    else:
        far = _far_zeros(search, fit, names, chain)
        if fit.error > max(_SETTINGS.named * spread, noise):
            far.append(f"{_drawn_arm_misses(_mm(before))}: they may be of another robot, or their columns misread")
        found = Plausibility(warnings=tuple(far), undirected=search.undirected(names))
        if robot.camera.pose_known:
            found = _turned(chain, q[rows], x[rows], fit) or found
        if held is not None and found.refusal is None:
            found = _turned_end(names, fit, *held)
        elif not robot.robot.marker_known and (nearer := search.with_marker_nearer(as_it_is)) is not None:
            looks, tool_m = nearer.looks(names, fit.zeros), search.fits[nearer].tool_m
            found = replace(found, warnings=(*found.warnings, f"perhaps {looks}: {_marker_then(tool_m, fit.tool_m)}"))
    if orientation is not None and chosen == as_it_is and found.refusal is None:
        found = _reordered(chain, q[rows] + fit.zeros, orientation[rows], fit) or found
    return _decided(replace(found, warnings=(*sized.warnings, *found.warnings)), len(q))


def _reordered(chain: RigidChain, q: FloatArray, orientation: FloatArray, fit: _Fit) -> Plausibility | None:
    """Return a refusal if the quaternions fit far better in another order, or inverted; else None."""
    errors = errors_rad(chain, q, fit.rotation, orientation)
    before, best = errors.pop(AS_IT_IS), min(errors, key=errors.__getitem__)
    after = errors[best]
    if before <= _SETTINGS.much_better * max(after, _SETTINGS.oriented_rad):
        return None
    return Plausibility(
        f"it seems that the columns qx, qy, qz, qw {best}: the orientations then fit to {math.degrees(after):.1f}°, "
        f"and as they are to {math.degrees(before):.1f}°",
        f"In the recording, {REMEDIES[best]}",
        misread=True,
    )


def _decided(found: Plausibility, pairs: int) -> Plausibility:
    """Turn a refusal into a warning where there are too few pairs."""
    if found.refusal is None or pairs >= FEWEST_ROWS:
        return found
    few = f"{found.refusal}. {found.remedy}. (These are {pairs} pairs: {FEWEST_ROWS} are needed to decide.)"
    return Plausibility(warnings=(few,))


def _far_zeros(search: _Search, fit: _Fit, names: tuple[str, ...], chain: RigidChain) -> list[str]:
    return [
        f"with the nominal links, the zero of {name} comes out {math.degrees(zero):+.0f}°: it is wrong, or the URDF is "
        "of another arm"
        for joint, (name, zero, slides) in enumerate(zip(names, fit.zeros, chain.prismatic, strict=True))
        if not slides and abs(zero) > _SETTINGS.far_zero_rad and search.nearer_is_worse(joint, fit)
    ]


def _hardly(before: str, after: str, nearest: str) -> Plausibility:
    """Return the refusal of a recording that no reading explains.

    Args:
        before, after: distances of the pairs as they are, and in the nearest reading.
        nearest: that reading in words; empty if it is the columns as they are.
    """
    doubted = f". The nearest reading is that {nearest}, and it does not fit" if nearest else ""
    return Plausibility(
        f"the pairs are hardly of this robot: {_drawn_arm_misses(before)}, and with joints exchanged, counting the "
        f"other way or a quarter turn off still by {after}",
        "Is the recording of another robot, or the URDF of another one, or is more than one thing wrong with the "
        f"columns? Where the positions are that noisy, say so with --sigma-mm{doubted}",
    )


def _drawn_arm_misses(before: str) -> str:
    return f"placed as well as it can be, the nominal arm misses the pairs by {before}"


def _nameable(reading: Reading, fit: _Fit, spread: float) -> bool:
    """Return True if a fit is better than that of any wrong reading with as many changes."""
    return fit.error < _SETTINGS.named / (1 + reading.changes) * spread


def _shifted(search: _Search, q: FloatArray, x: FloatArray, before: float) -> Plausibility | None:
    """Return a refusal if each position belongs to the angles of a row nearby; else None.

    Args:
        search: the search over other readings, which found none.
        q, x: all pairs (n, d) [rad, m] and (n, 3) [m].
        before: distance of the pairs as they are [m].
    """
    shifts, rows = _rows_nearby(len(q))
    errors = search.errors(np.stack([q[rows + shift] for shift in shifts]), np.stack([x[rows]] * len(shifts)))
    best = int(errors.argmin())
    after, shift = float(errors[best]), shifts[best]
    if after > _SETTINGS.named / 2 * spread_m(x) or before < _SETTINGS.much_better * after:
        return None
    row, remedy = _moved(shift)
    return Plausibility(
        f"it seems that angles and positions are shifted against each other: with the angles of {row}, the pairs fit "
        f"to {_mm(after)}, and as they are to {_mm(before)}",
        remedy,
        misread=True,
    )


def _partly_shifted(search: _Search, q: FloatArray, x: FloatArray, *, fits: bool) -> Plausibility | None:
    """Return a refusal if in many rows, and not in most, angles or positions belong to a row nearby; else None.

    Args:
        search: the search over other readings.
        q, x: all pairs (n, d) [rad, m] and (n, 3) [m].
        fits: the pairs place the arm. Else every row may be wrong, and the arm is also placed by shifted rows.
    """
    if len(q) < FEWEST_ROWS:
        return None
    shifts, rows = _rows_nearby(len(q))
    own_q, own_x = q[rows], x[rows]
    of_angles = [(q[rows + shift], own_x) for shift in shifts]
    pairs = [(own_q, own_x), *of_angles, *((own_q, x[rows + shift]) for shift in shifts)]
    placed_by = [(own_q, own_x), *([] if fits else of_angles)]
    found = np.stack([search.distances(*placed, pairs) for placed in placed_by])
    nearer = _SETTINGS.shifted_better * found.min(axis=0)[1:] < found[0, 0]
    shares = nearer.mean(axis=1).reshape(2, -1)
    angles, positions = shares.max(axis=1)
    if max(angles, positions) < _SETTINGS.shifted:
        return None
    row, remedy = _moved(shifts[int(shares[0].argmax())])
    fit, remedy = f"these fit the angles of {row}", f"In these rows: {remedy[0].lower()}{remedy[1:]}"
    if positions > _SETTINGS.much_better * angles:
        fit = f"their angles fit the positions of {_moved(shifts[int(shares[1].argmax())])[0]}"
        remedy = "Join the two logs by time, not by row: rows hold the angles of others"
    return Plausibility(
        "it seems that angles and positions are shifted against each other in "
        f"{100.0 * max(angles, positions):.0f} % of the rows: {fit}",
        remedy,
        misread=True,
    )


def _rows_nearby(count: int) -> tuple[list[int], NDArray[np.intp]]:
    """Return shifts, and rows of a recording of `count` that have neighbours so far away."""
    near = _SETTINGS.near_rows
    shifts = [shift for shift in range(-near, near + 1) if shift]
    return shifts, np.unique(np.linspace(near, count - 1 - near, ROWS).astype(np.intp))


def _moved(shift: int) -> tuple[str, str]:
    """Return what row it is whose angles fit, and the remedy."""
    count, where = abs(shift), "later" if shift > 0 else "earlier"
    rows = f"{count} row{'s' if count > 1 else ''}"
    return (
        f"{rows} {where}",
        f"Move the columns of the joints by {rows} {'up' if shift > 0 else 'down'}, or the positions the other way; or "
        "join the two logs by time, not by row",
    )


def _turned(chain: RigidChain, q: FloatArray, x: FloatArray, fit: _Fit) -> Plausibility | None:
    """Return a refusal if the measurement frame is turned against a pose that robot.toml declares known; else None."""
    angle = float(np.linalg.norm(rotation_vector(fit.rotation)))
    if angle < _SETTINGS.turned_rad:
        return None
    told, free = (align(chain, q, x, pose_known=known, marker_known=False).rms for known in (True, False))
    if told < _SETTINGS.much_better * free:
        return None
    return Plausibility(
        f"it seems that the measurement frame is turned by {math.degrees(angle):.0f}° against [camera] of robot.toml"
        f"{_frame(fit.rotation, False)}: the pairs then fit to {_mm(free)}, and as they are to {_mm(told)}",
        "Correct the columns x, y, z, the pose of the camera or the zero of the first joint; or set pose_known = false",
        misread=True,
    )


def _marker_then(then_m: float, now_m: float) -> str:
    return (
        f"the marker then comes out {_mm(then_m)} from its place in [robot] of robot.toml, and as the columns are "
        f"{_mm(now_m)} from it"
    )


def _turned_end(names: tuple[str, ...], as_it_is: _Fit, reading: Reading, fit: _Fit) -> Plausibility:
    """Report that a zero near the hand is off by quarter turns: only that explains the known marker position."""
    return Plausibility(
        f"it seems that {reading.looks(names, fit.zeros)}: {_marker_then(fit.tool_m, as_it_is.tool_m)}",
        f"{reading.remedy(names, fit.zeros)}. Or correct marker_xyz, or set marker_known = false",
        misread=True,
    )


def _frame(rotation: FloatArray, mirrored: bool) -> str:
    """Return the order and signs in which x, y, z are given, if they are axes of the frame in robot.toml; else ""."""
    given = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0]) @ rotation
    which = np.abs(given).argmax(axis=1)
    along = np.abs(given).max(axis=1)
    if len(set(which.tolist())) < 3 or along.min() < math.cos(_SETTINGS.turned_rad):
        return ""
    order = ", ".join(f"{'-' if given[k, axis] < 0.0 else ''}{'xyz'[axis]}" for k, axis in enumerate(which))
    return f" (the columns x, y, z hold {order})"


class _Search:
    """Search over readings of the same pairs, with their fits."""

    def __init__(self, chain: RigidChain, q: FloatArray, x: FloatArray, exact_m: float, pose_known: bool) -> None:
        self._chain, self._q, self._x, self._exact_m, self._pose_known = chain, q, x, exact_m, pose_known
        self._parameters = ChainParameters(chain)
        self._std = np.where(chain.prismatic, SLIDES_M, ZEROS_RAD)
        self._apart = _poses_apart(q / np.where(chain.prismatic, A_RADIAN_M, 1.0))
        self._poses = len(self._apart)
        self._tried: set[Reading] = set()
        self.fits: dict[Reading, _Fit] = {}

    def verdict(self) -> tuple[Reading, Reading, list[Reading]]:
        """Return the columns as they are, the simplest reading among the best, and others nearly as simple."""
        as_it_is = Reading.plain(self._chain.joints)
        slides: list[bool] = self._chain.prismatic.tolist()
        self._try([as_it_is, *as_it_is.neighbours(slides)])
        if self._best()[0] != as_it_is:
            # With a marker far from nominal, the fit of the right reading may have ended in a local minimum.
            self._fit([as_it_is] * 6, tools=TOOL_M * np.concatenate([np.eye(3), -np.eye(3)]))
        expanded, spread = [as_it_is], spread_m(self._x)
        for depth in range(1, _SETTINGS.depth):
            best = self._best()[0]
            left = self.fits[best].error / spread
            if best in expanded and (
                left < _SETTINGS.enough or (best == as_it_is and (left < _SETTINGS.enough_as_it_is or depth > 1))
            ):
                break
            new = self._distinct(expanded)
            expanded += new
            if depth == 1:
                self._try(as_it_is.doubles(slides))
            self._try(other for reading in new for other in reading.neighbours(slides))
        best = self._best()[0]
        if self.fits[best].error > (_SETTINGS.enough_as_it_is if best == as_it_is else _SETTINGS.enough) * spread:
            self._try(as_it_is.mixed(slides))
        best = self._best()[0]
        if not _nameable(best, self.fits[best], spread):
            self._fit([as_it_is], tools=self._aligned_tool())
            self._try(as_it_is.mixed_exchanges(slides))
            self._try(other for reading in self._distinct(expanded) for other in reading.neighbours(slides))
        if as_it_is not in self.fits:
            self._fit([as_it_is], held=True)
        best, refuted = self._most_probable(as_it_is)
        good = sorted(
            (
                reading
                for reading, fit in self.fits.items()
                if self._as_good(fit, self.fits[best]) and not self._alike(fit.error, refuted)
            ),
            key=lambda reading: (reading.changes, reading.quarters != as_it_is.quarters, self.fits[reading].nats),
        )
        others = [reading for reading in good[1:] if reading.changes <= good[0].changes + 1]
        return as_it_is, good[0], others[: _SETTINGS.listed]

    def _aligned_tool(self) -> FloatArray:
        """Return the marker's offset (1, 3) [m] with nominal joint offsets: its fit starts from many places."""
        try:
            return align(self._chain, self._q, self._x, pose_known=False, marker_known=False).marker_shift[None]
        except DegenerateDataError:
            return np.zeros((1, 3))

    def nearer_is_worse(self, joint: int, fit: _Fit) -> bool:
        """Return True if the unchanged columns fit clearly worse than `fit` with a joint's zero `near_zero_rad` off."""
        q, here = self._q.copy(), np.arange(self._chain.joints) == joint
        q[:, joint] += math.copysign(_SETTINGS.near_zero_rad, fit.zeros[joint])
        held = place(
            self._chain,
            q[None],
            self._x[None],
            zeros_std=np.where(here, _SETTINGS.held, 1.0) * self._std,
            tool_std=TOOL_M,
        )
        ratio = max(float(held.errors(MEASURED)[0]), self._exact_m) / fit.error
        return ratio > _SETTINGS.much_better and 3.0 * MEASURED * self._poses * math.log(ratio) > _SETTINGS.certain

    def sized(self, before: float, best: float) -> Plausibility | None:
        """Return what to say of positions that are too large or too small for the arm; None if they are not.

        Args:
            before: distance of the pairs as they are [m].
            best: the same, in the best reading of the columns.
        """
        size = size_of(self._chain, self._q, self._x, self._apart)
        after = max(size.error, self._exact_m)
        far = size.sigmas > _SETTINGS.far_size and after < _SETTINGS.named / 2 * spread_m(self._x)
        if not far or best < _SETTINGS.as_good * after:
            return None
        factor, low, high = (size.factor * math.exp(k * size.log_sigma) for k in (0.0, -1.96, 1.96))
        text = (
            f"the positions are {factor:.3g} times as large as the arm makes them (95 %: {low:.4g} to {high:.4g}): "
            f"divided by that, the pairs fit to {_mm(after)}, and as they are to {_mm(before)}"
        )
        remedy = (
            "Compare with what was measured: the size of the printed tag or the ball in [vision], the squares of the "
            "calibration board, the unit of the columns x, y, z. If these are right, the URDF is of an arm of another "
            "size"
        )
        if best > _SETTINGS.much_better * after and abs(math.log(size.factor)) > _SETTINGS.other_size:
            return Plausibility(f"it seems that {text}", remedy, misread=True)
        return Plausibility(warnings=(f"perhaps {text}. {remedy}",))

    def errors(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """Return the distances (s,) [m] of sets of pairs q (s, n, d) and x (s, n, 3), with the columns as they are."""
        placed = place(self._chain, q, x, zeros_std=self._std, tool_std=TOOL_M)
        return np.maximum(placed.errors(MEASURED), self._exact_m)

    def distances(self, q: FloatArray, x: FloatArray, pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Return the distances (s, n) [m] of sets of pairs from the arm as pairs q (n, d) and x (n, 3) place it."""
        placed, p = place(self._chain, q[None], x[None], zeros_std=self._std, tool_std=TOOL_M), self._parameters
        change = np.zeros(p.size)
        change[p.zeros], change[p.tool] = placed.zeros[0], placed.tools[0]
        drawn = (p.positions(change, each) @ placed.rotations[0].T + placed.shifts[0] for each, _ in pairs)
        return np.stack([np.linalg.norm(at - seen, axis=1) for at, (_, seen) in zip(drawn, pairs, strict=True)])

    def with_marker_known(self, reading: Reading) -> tuple[Reading, _Fit] | None:
        """Return the reading with a zero near the hand off by quarter turns, and its fit, if the known marker shows it.

        With a free marker position such a turn makes no difference.
        """
        if self._chain.prismatic[-1]:
            return None
        last = np.arange(self._chain.joints) == self._chain.joints - 1
        std = np.where(last, _SETTINGS.last_zero_rad, self._std)
        turned = [reading.turned((turns * last).tolist()) for turns in (0, 1, -1, 2)] + self._turned_alike(reading)
        fits = self._placed(turned, std=std, tool_m=KNOWN_TOOL_M)
        as_given = fits.pop(reading, None)
        best = min(fits, key=lambda each: fits[each].nats + _SETTINGS.a_change * each.changes, default=reading)
        if best not in turned or best == reading:
            return None
        fit = fits[best]
        # Without a fit the known marker itself has led from this reading to another one.
        clearly = as_given is None or fit.nats + _SETTINGS.certain < as_given.nats
        far = _SETTINGS.nearer * fit.tool_m < (as_given or self.fits[reading]).tool_m
        return (best, fit) if clearly and far else None

    def with_marker_nearer(self, reading: Reading) -> Reading | None:
        """Return the reading with other quarter turns, as good a fit, that brings a far marker near to its place."""
        best = min(self._turned_alike(reading), key=lambda each: self.fits[each].tool_m, default=reading)
        far = self.fits[reading].tool_m > _SETTINGS.nearer * max(self.fits[best].tool_m, KNOWN_TOOL_M)
        return best if far else None

    def _turned_alike(self, reading: Reading) -> list[Reading]:
        """Return the readings with other quarter turns that fit as well."""
        return [
            other
            for other, fit in self.fits.items()
            if other != reading
            and replace(other, quarters=reading.quarters) == reading
            and self._as_good(fit, self.fits[reading])
        ]

    def undirected(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the joints whose sign makes no difference."""
        plain = Reading.plain(len(names))
        fits = (
            (name, self.fits.get(reading))
            for name, reading in zip(names, plain.neighbours(self._chain.prismatic.tolist()), strict=False)
        )
        return tuple(name for name, fit in fits if fit is not None and self._as_good(fit, self.fits[plain]))

    def _best(self) -> list[Reading]:
        """Return all readings, the best first."""
        return sorted(self.fits, key=lambda reading: self.fits[reading].nats + _SETTINGS.a_change * reading.changes)

    def _most_probable(self, as_it_is: Reading) -> tuple[Reading, list[float]]:
        """Return the most probable reading with links of some tolerance, and the errors of better fits that it refutes.

        With nominal links a wrong reading may fit better: its marker and joint offsets make up for errors of the links.
        They do so only where the columns as they are place the arm. These may be the wrong reading that fits better.
        """
        rivals, spread = self._distinct([]), spread_m(self._x)
        own = self.fits.get(as_it_is)
        if own is None or own.error >= _SETTINGS.named * spread:
            return rivals[0], []
        nearest = rivals[0]
        if nearest == as_it_is:
            rivals = [each for each in rivals if _nameable(each, self.fits[each], spread)]
        rivals += [as_it_is] if as_it_is not in rivals else []
        if rivals == [as_it_is]:
            return as_it_is, []
        slides = self._chain.prismatic
        read = [(each.angles(self._q, slides), each.positions(self._x), each.scale) for each in rivals]
        changes = np.array([reading.changes for reading in rivals])
        probable = evidences(self._chain, read, self._apart) - _SETTINGS.a_change * changes
        # Where the columns as they are fit best, another reading has to be certain twice.
        probable[rivals.index(as_it_is)] += 2.0 * _SETTINGS.certain if nearest == as_it_is else 0.0
        best = rivals[int(probable.argmax())]
        nats, error = self.fits[best].nats, self.fits[best].error
        fits = [self.fits[reading] for reading in rivals]
        return best, [fit.error for fit in fits if fit.nats < nats and not self._alike(error, [fit.error])]

    @staticmethod
    def _alike(error: float, others: list[float]) -> bool:
        return any(abs(error - other) <= _SETTINGS.same * other for other in others)

    def _distinct(self, expanded: list[Reading]) -> list[Reading]:
        """Return the best readings whose fits differ from those already expanded, and from each other."""
        seen, new = [self.fits[reading].error for reading in expanded if reading in self.fits], list[Reading]()
        for reading in self._best():
            error = self.fits[reading].error
            if not self._alike(error, seen):
                new.append(reading)
                seen.append(error)
            if len(new) == _SETTINGS.width:
                break
        return new

    @staticmethod
    def _as_good(fit: _Fit, best: _Fit) -> bool:
        return fit.nats < best.nats + _SETTINGS.certain or fit.error < _SETTINGS.as_good * best.error

    def _try(self, readings: Iterable[Reading]) -> None:
        """Fit readings that were not tried yet."""
        new = [reading for reading in dict.fromkeys(readings) if reading not in self._tried]
        self._tried.update(new)
        if new:
            self._fit(new)

    def _fit(self, new: list[Reading], *, held: bool = False, tools: FloatArray | None = None) -> None:
        """Fit readings, and keep the best fit of each.

        Args:
            new: the readings.
            held: keep the joint offsets at nominal.
            tools: marker offsets (s, 3) [m] to start from.
        """
        std = self._std * (_SETTINGS.held if held else 1.0)
        for reading, fit in self._placed(new, std=std, tools=tools).items():
            if reading not in self.fits or fit.nats < self.fits[reading].nats:
                self.fits[reading] = fit

    def _placed(
        self, new: list[Reading], *, std: FloatArray, tool_m: float = TOOL_M, tools: FloatArray | None = None
    ) -> dict[Reading, _Fit]:
        """Return the best fit of each reading; a zero that goes to the next quarter turn makes it another reading.

        Args:
            std: how far each zero may be off (d,) [rad, m]; 1-sigma.
            tool_m: how far the marker may be from its place [m]; 1-sigma of a coordinate.
            tools: moves of the marker (s, 3) [m] to start from.
        """
        slides = self._chain.prismatic
        q = np.stack([reading.angles(self._q, slides) for reading in new])
        x = np.stack([reading.positions(self._x) for reading in new])
        placed = place(self._chain, q, x, zeros_std=std, tool_std=tool_m, tools=tools)
        quarters = np.where(slides, 0, np.rint(placed.zeros / QUARTER)).astype(np.intp)
        zeros = placed.zeros - QUARTER * quarters
        errors = np.maximum(placed.errors(MEASURED), self._exact_m) * [reading.scale for reading in new]
        moved = np.linalg.norm(placed.tools, axis=1)
        cost = 0.5 * np.square(zeros / std).sum(axis=1) + 0.5 * np.square(moved / tool_m)
        if self._pose_known:
            turns = np.linalg.norm(rotation_vectors(placed.rotations), axis=1)
            cost += [
                0.0 if r.mirrored else 0.5 * (turn / _SETTINGS.turned_rad) ** 2
                for r, turn in zip(new, turns, strict=True)
            ]
        nats = 3.0 * MEASURED * self._poses * np.log(errors) + cost
        fits: dict[Reading, _Fit] = {}
        for k, reading in enumerate(new):
            found = reading.turned(quarters[k].tolist())
            fit = _Fit(float(errors[k]), float(nats[k]), zeros[k], float(moved[k]), placed.rotations[k])
            if found not in fits or fit.nats < fits[found].nats:
                fits[found] = fit
        return fits


def _poses_apart(q: FloatArray) -> list[int]:
    """Return poses of q (n, d) that are `apart_rad` from each other, in at least one joint."""
    apart = np.abs(q[:, None] - q).max(axis=2) > _SETTINGS.apart_rad
    kept: list[int] = []
    for pose, far in enumerate(apart):
        if far[kept].all():
            kept.append(pose)
    return kept


def _mm(distance_m: float) -> str:
    return f"{1e3 * distance_m:.3g} mm" if distance_m < 1.0 else f"{distance_m:.3g} m"
