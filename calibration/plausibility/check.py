"""Check that a recording can be of this robot, before any fit of it is trusted.

A rigid chain with free links fits a recording with a flipped joint or an offset of 90° as well as the right one, but
with meaningless links. So the links are kept at nominal, and the pose of the camera, the marker and the joint offsets
are fitted to many ways to read the columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription
from kbmaps import RigidChain, align, rotation_matrices
from kbmaps.rotations import rotation_vector

from .limits import place_an_arm, reach_m, spread_m
from .markers import several_markers
from .reading import Reading
from .rows import all_shifted, few_outliers, many_apart, partly_carried, partly_shifted
from .search import ReadingFit, ReadingSearch, SearchSettings, nameable
from .size import size_of, wrong_size
from .verdict import FEWEST_ROWS, THRESHOLDS, Plausibility, mm


class _Settings:
    """Limits beyond which a recording is not of the arm, in any reading."""

    # A fit with residuals above these shares of the positions' spread and of the arm's reach is not of this arm.
    unexplained: float = 0.25
    of_reach: float = 0.02
    noises: float = 5.0  # ... and above this multiple of the known noise.
    of_one_marker: float = 0.01  # several markers are looked for from this share of the spread on
    exact: float = 1e-5  # distances below this share of the reach are not distinguished


def recorded_sigma(recording: Recording) -> float | None:
    """Return the 1-sigma of a coordinate [m], if the recording has it."""
    if recording.cov is None:
        return None
    return float(np.sqrt(np.trace(recording.cov, axis1=1, axis2=2).mean() / 3.0))


def plausibility(
    robot: RobotDescription,
    q: FloatArray,
    x: FloatArray,
    *,
    t: FloatArray | None = None,
    chain: RigidChain | None = None,
    sigma_m: float | None = None,
    orientation: FloatArray | None = None,
) -> Plausibility:
    """Check pairs q (n, d) [rad, m] and x (n, 3) [m] before a fit to them is trusted.

    Args:
        t: times (n,) [s] if known.
        chain: the nominal chain if it is not the robot's.
        sigma_m: 1-sigma of a coordinate [m] if known.
        orientation: orientations of the marker, quaternions x, y, z, w (n, 4), if known.
    """
    chain = chain or robot.chain
    exact_m, spread = _Settings.exact * reach_m(robot), spread_m(x)
    if not place_an_arm(len(q), chain.joints) or spread < exact_m:
        return Plausibility()
    rows = np.unique(np.linspace(0, len(q) - 1, SearchSettings.rows).astype(np.intp))
    search = ReadingSearch(chain, q[rows], x[rows], exact_m, robot.camera.pose_known)
    noise = 0.0 if sigma_m is None else _Settings.noises * sigma_m
    check = _Check(robot, search, *search.verdict(), spread, noise)
    found = check.rows_and_size(q, x, t)
    if found.refusal is None:
        columns = check.columns(None if orientation is None else orientation[rows])
        found = replace(columns, warnings=(*found.warnings, *columns.warnings))
    return _softened(found, search, len(q))


@dataclass(frozen=True, slots=True)
class _Check:
    robot: RobotDescription  # the robot's description
    search: ReadingSearch  # the finished search over readings of the columns
    unchanged: Reading  # the unchanged columns
    best: Reading  # the simplest among the best readings
    others: list[Reading]  # others nearly as simple
    spread: float  # of the positions [m]
    noise: float  # largest distance that the known noise explains [m]

    def rows_and_size(self, q: FloatArray, x: FloatArray, t: FloatArray | None) -> Plausibility:
        """Return the faults of the rows or the size of all pairs q (n, d) [rad, m], x (n, 3) [m] and t (n,)."""
        search, best = self.search, self.search.fits[self.best].error
        placed = self._is_nameable(self.unchanged) or self._is_nameable(self.best)
        if not placed or many_apart(search, THRESHOLDS.named * self.spread):
            shifted = all_shifted(search, q, x, t)
            if shifted is not None:
                return shifted
        if not (self._fits_clearly_better and self._is_nameable(self.best)):
            fits = self._error_unchanged < THRESHOLDS.named * self.spread
            refusal_found = (partly_carried(search, self.robot.joints) if fits else None) or partly_shifted(
                search, q, x, t, fits=fits
            )
            if refusal_found is None and self._error_unchanged > _Settings.of_one_marker * self.spread:
                refusal_found = several_markers(search, self._error_unchanged)
            if refusal_found is not None:
                return refusal_found
        size = size_of(search.chain, search.q, search.x, search.poses.rows, search.exact_m)
        return wrong_size(size, spread_m(search.x), self._error_unchanged, best) or Plausibility()

    def columns(self, orientation: FloatArray | None) -> Plausibility:
        """Return the faults of the columns.

        Args:
            orientation: orientations of the marker in the rows of the search, quaternions x, y, z, w (n, 4), if known.
        """
        search, reading = self.search, self.best
        if not (self._fits_clearly_better or self._is_nameable(reading)):
            reading = self.unchanged
        fit = search.fits[reading]
        after = fit.error / reading.scale
        turned = search.with_marker_known(reading) if self.robot.robot.marker_known else None
        if turned is not None and reading != self.unchanged:
            reading, fit = turned
        other_arm_limit = max(
            _Settings.unexplained * self.spread / reading.scale, _Settings.of_reach * reach_m(self.robot), self.noise
        )
        not_nameable = reading != self.unchanged and not nameable(reading, fit, self.spread)
        if after > other_arm_limit or (not_nameable and after > self.noise):
            outliers = few_outliers(search, self._error_unchanged)
            return Plausibility(warnings=(outliers,)) if outliers else self._report_no_reading(reading, fit, after)
        if reading != self.unchanged:
            return self._report_other_reading(reading, fit, after)
        found = self._report_unchanged(fit, turned)
        if orientation is None or found.refusal is not None:
            return found
        return reordered_quaternions(search.chain, search.q + fit.zeros, orientation, fit) or found

    @property
    def _error_unchanged(self) -> float:
        """Distance of the pairs with unchanged columns [m]."""
        return self.search.fits[self.unchanged].error

    @property
    def _fits_clearly_better(self) -> bool:
        return self._error_unchanged > THRESHOLDS.much_better * self.search.fits[self.best].error

    def _is_nameable(self, reading: Reading) -> bool:
        return nameable(reading, self.search.fits[reading], self.spread)

    def _report_no_reading(self, nearest: Reading, fit: ReadingFit, after: float) -> Plausibility:
        nearest_text = ""
        if nearest != self.unchanged:
            label = nearest.label(self.robot.joints, fit.zeros)
            nearest_text = f". The nearest reading is that {label}, and it does not fit"
        return Plausibility(
            f"the samples are hardly of this robot: {self._nominal_arm_misses()}, and with joints exchanged, counting "
            f"the other way or a quarter turn off still by {mm(after)}",
            "Is the recording or the URDF of another robot, is the camera on the hand and the marker in the room, are "
            "the time stamps late (`bodyschema diagnose --force` measures it), or is more than one thing wrong with "
            f"the columns? Where the positions are that noisy, say so with --sigma-mm{nearest_text}",
            better=self._error_unchanged / (THRESHOLDS.right * self.spread),
        )

    def _report_other_reading(self, reading: Reading, fit: ReadingFit, after: float) -> Plausibility:
        """Report another reading that fits better than the unchanged columns."""
        names = self.robot.joints
        mirrored = self.robot.camera.pose_known and reading.mirrored
        frame = order_of_axes(fit.rotation, mirrored=True) if mirrored else ""
        fits = f"the samples then fit to {mm(after)}, and as they are to {mm(self._error_unchanged)}"
        text = f"{reading.label(names, fit.zeros)}{frame}: {fits}"
        if after > self._error_unchanged:
            text = (
                f"{text}, but with links that are off by as much as those of arms this is more probable. Check it on "
                "the arm before you use the model"
            )
        alternatives = "; or ".join(other.label(names, self.search.fits[other].zeros) for other in self.others)
        alternatives = f". These samples fit as well if {alternatives}" if alternatives else ""
        if self._error_unchanged > THRESHOLDS.much_better * fit.error:
            better = self._error_unchanged / max(fit.error, self.search.exact_m)
            remedy = reading.remedy(names, fit.zeros) + alternatives
            return Plausibility(f"it seems that {text}", remedy, misread=True, better=better)
        return Plausibility(warnings=(f"perhaps {text}{alternatives}",))

    def _report_unchanged(self, fit: ReadingFit, by_marker: tuple[Reading, ReadingFit] | None) -> Plausibility:
        """Report on columns that are right, except for the last joint's offset and the measurement frame."""
        search, names = self.search, self.robot.joints
        turned = None
        if self.robot.camera.pose_known:
            turned = turned_frame(search.chain, search.q, search.x, fit)
        if by_marker is not None and turned is None:
            reading, new_fit = by_marker
            return Plausibility(
                f"it seems that {reading.label(names, new_fit.zeros)}: {_marker_text(new_fit.tool_m, fit.tool_m)}",
                f"{reading.remedy(names, new_fit.zeros)}. Or correct marker_xyz, or set marker_known = false",
                misread=True,
            )
        found = turned or self._warnings(fit)
        nearer = None if self.robot.robot.marker_known else search.with_marker_nearer(self.unchanged)
        if nearer is None:
            return found
        label = nearer.label(names, fit.zeros)
        perhaps = f"perhaps {label}: {_marker_text(search.fits[nearer].tool_m, fit.tool_m)}"
        return replace(found, warnings=(*found.warnings, perhaps))

    def _warnings(self, fit: ReadingFit) -> Plausibility:
        names = self.robot.joints
        warnings = [
            f"with the nominal links, the zero of {name} comes out {math.degrees(zero):+.0f}°: it is wrong, or the "
            "URDF is of another arm"
            for joint, (name, zero) in enumerate(zip(names, fit.zeros, strict=True))
            if self.search.has_far_zero(joint, fit)
        ]
        if fit.error > max(THRESHOLDS.named * self.spread, self.noise):
            other = f"{self._nominal_arm_misses()}: they may be of another robot, or their columns misread"
            warnings.append(few_outliers(self.search, self._error_unchanged) or other)
        return Plausibility(warnings=tuple(warnings), undirected=self.search.undirected(names))

    def _nominal_arm_misses(self) -> str:
        return f"placed as well as it can be, the nominal arm misses the samples by {mm(self._error_unchanged)}"


def _softened(found: Plausibility, search: ReadingSearch, pairs: int) -> Plausibility:
    """Turn a refusal into a warning if there are too few pairs or poses for it."""
    enough = pairs >= FEWEST_ROWS and (found.better == 1.0 or search.is_certain(math.log(found.better)))
    if found.refusal is None or enough or found.better >= THRESHOLDS.decisively:
        return found
    many = f"{pairs} samples of {len(search.poses.rows)} poses"
    few = f"{found.refusal}. {found.remedy}. (These are {many}: about {FEWEST_ROWS} poses decide.)"
    return Plausibility(warnings=(few,))


def _marker_text(then_m: float, now_m: float) -> str:
    return (
        f"the marker then comes out {mm(then_m)} from its place in [robot] of robot.toml, and as the columns are "
        f"{mm(now_m)} from it"
    )


# Orders of a quaternion in the columns qx, qy, qz, qw.
_UNCHANGED = ""
_SCALAR_FIRST = "hold a quaternion with w first"
_CONJUGATE = "hold the conjugate of the marker's orientation, that of the measurement frame in the marker"
_REORDER = "name the columns qw, qx, qy, qz"
_NEGATE = "multiply qx, qy and qz by -1"
_REMEDIES = {
    _SCALAR_FIRST: _REORDER,
    _CONJUGATE: _NEGATE,
    f"{_SCALAR_FIRST}, and {_CONJUGATE}": f"{_REORDER}, and {_NEGATE}",
}


def turned_frame(chain: RigidChain, q: FloatArray, x: FloatArray, fit: ReadingFit) -> Plausibility | None:
    """Return a refusal if the frame is rotated against a pose that robot.toml declares known, otherwise None."""
    angle = float(np.linalg.norm(rotation_vector(fit.rotation)))
    if angle < THRESHOLDS.turned_rad:
        return None
    rms_known, rms_free = (align(chain, q, x, pose_known=known, marker_known=False).rms for known in (True, False))
    if rms_known < THRESHOLDS.much_better * rms_free:
        return None
    return Plausibility(
        f"it seems that the measurement frame is turned by {math.degrees(angle):.0f}° against [camera] of robot.toml"
        f"{order_of_axes(fit.rotation, mirrored=False)}: the samples then fit to {mm(rms_free)}, and as they are to "
        f"{mm(rms_known)}",
        "Correct the columns x, y, z, the pose of the camera or the zero of the first joint; or set pose_known = false",
        misread=True,
    )


def order_of_axes(rotation: FloatArray, *, mirrored: bool) -> str:
    """Return the order and signs in which x, y, z are given, if they are axes of robot.toml's frame, otherwise ""."""
    axes = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0]) @ rotation
    indices = np.abs(axes).argmax(axis=1)
    lengths = np.abs(axes).max(axis=1)
    if len(set(indices.tolist())) < 3 or lengths.min() < math.cos(THRESHOLDS.turned_rad):
        return ""
    order = ", ".join(f"{'-' if axes[k, axis] < 0.0 else ''}{'xyz'[axis]}" for k, axis in enumerate(indices))
    return f" (the columns x, y, z hold {order})"


def reordered_quaternions(
    chain: RigidChain, q: FloatArray, orientation: FloatArray, fit: ReadingFit
) -> Plausibility | None:
    """Return a refusal if the quaternions fit far better in another order, or inverted, otherwise None."""
    plain, first, conjugate = orientation, np.roll(orientation, -1, axis=1), np.array([-1.0, -1.0, -1.0, 1.0])
    readings = zip((_UNCHANGED, *_REMEDIES), (plain, first, plain * conjugate, first * conjugate), strict=True)
    hand = fit.rotation @ chain.orientation(q)
    errors = {name: _scatter(hand.swapaxes(1, 2) @ rotation_matrices("orientation", read)) for name, read in readings}
    before, best = errors.pop(_UNCHANGED), min(errors, key=errors.__getitem__)
    after = errors[best]
    better = before / max(after, THRESHOLDS.oriented_rad)
    if better <= THRESHOLDS.much_better:
        return None
    return Plausibility(
        f"it seems that the columns qx, qy, qz, qw {best}: the orientations then fit to {math.degrees(after):.1f}°, "
        f"and as they are to {math.degrees(before):.1f}°",
        f"In the recording, {_REMEDIES[best]}",
        misread=True,
        better=better,
    )


def _scatter(turns: FloatArray) -> float:
    """Return the median angle [rad] of rotations (n, 3, 3) from the one that is nearest to the others."""
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    return math.acos(float(np.clip(np.median(cosines, axis=1).max(), -1.0, 1.0)))
