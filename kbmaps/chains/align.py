"""Best rigid fit of a nominal chain to measurements: camera pose, marker offset, or both."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from kbmaps.arrays import BoolArray, FloatArray, evenly_spread, frozen, matching_rows, numbers, require_positive
from kbmaps.chains.chain import RigidChain
from kbmaps.chains.parameters import ChainParameters, ChainTolerances
from kbmaps.errors import DegenerateDataError, ShapeError
from kbmaps.maps.kbmap import POSITION_OUTPUTS, KBMap
from kbmaps.pairs import checked_pairs
from kbmaps.robust import RobustSettings, middle_sigma
from kbmaps.rotations import cross_matrix, exponentials, nearest_rotation, rotation_vector


class _Settings:
    rounds: int = 60
    start_pairs: int = 300
    step_tolerance: float = 1e-12
    # Starting points are only compared: the best one is fitted again, to the tolerance above.
    trial_tolerance: float = 1e-5
    placed: int = 64  # this many evenly spread pairs suffice to place the arm
    # Singular values below this share of the largest are directions that the data do not determine.
    rank_tolerance: float = 1e-7


@dataclass(frozen=True, eq=False)
class Alignment:
    """Nominal chain fitted to measured pairs by rigid motion alone.

    Attributes:
        chain: the nominal chain with the fitted motion built in.
        T_measured_nominal: pose (4, 4) of the nominal measurement frame in the real one; identity if it was known.
        marker_shift: offset of the marker (3,) [m] in the marker frame; zero if it was known.
        rms: RMS distance [m] between the fitted chain and the inliers.
        inliers: True for each pair (n,) that is not an outlier.
    """

    chain: RigidChain
    T_measured_nominal: FloatArray
    marker_shift: FloatArray
    rms: float
    inliers: BoolArray


@dataclass
class _Fit:
    """Current estimate for nominal poses: x ≈ rotation (p + R δ) + translation."""

    nominal_rotations: FloatArray
    nominal_positions: FloatArray
    x: FloatArray
    fit_pose: bool
    fit_marker: bool
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))
    shift: FloatArray = field(default_factory=lambda: np.zeros(3))

    def markers(self) -> FloatArray:
        """Return the marker positions (n, 3) in the nominal frame."""
        return self.nominal_positions + self.nominal_rotations @ self.shift

    def errors(self) -> FloatArray:
        return self.x - (self.markers() @ self.rotation.T + self.translation)

    def norms(self) -> FloatArray:
        return np.linalg.norm(self.errors(), axis=1)

    def spread(self, least: float) -> float:
        """Return a robust standard deviation [m] of one coordinate's error, at least `least`."""
        return max(middle_sigma(self.norms(), len(self.x) // 2 + 2 * self.fit_pose + self.fit_marker), least)

    def place(self, weights: FloatArray) -> None:
        self.rotation, self.translation = rigid_motion(self.markers(), self.x, weights)

    def improve(self, weights: FloatArray) -> float:
        """Take one weighted Gauss-Newton step in all fitted parameters; return its size (rad and m added)."""
        turned = self.markers() @ self.rotation.T
        columns: list[FloatArray] = []
        if self.fit_pose:
            # rotation ← exp(ω) rotation moves a point by ω × point = −[point]× ω.
            columns += [-cross_matrix(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))]
        if self.fit_marker:
            columns.append(self.rotation @ self.nominal_rotations)
        root = np.sqrt(weights)[:, None]
        design = (np.concatenate(columns, axis=2) * root[:, :, None]).reshape(3 * len(turned), -1)
        target = (self.errors() * root).ravel()
        step = cast(FloatArray, np.linalg.lstsq(design, target, rcond=_Settings.rank_tolerance)[0])
        if self.fit_pose:
            self.rotation = exponentials(step[:3][None])[0][0] @ self.rotation
            self.translation = self.translation + step[3:6]
        if self.fit_marker:
            self.shift = self.shift + step[-3:]
        return float(np.abs(step).sum())


def align(
    chain: RigidChain,
    q: ArrayLike,
    x: ArrayLike,
    *,
    pose_known: bool,
    marker_known: bool,
    sigma: float | None = None,
    turns: ArrayLike | None = None,
) -> Alignment:
    """Fit the unknown camera pose and marker offset to measured pairs.

    Needs no initial guess and withstands gross outliers. The final fit is plain least squares over the inliers. If pose
    and marker offset can compensate for each other (a chain whose last frame hardly rotates), the combination that
    changes the nominal chain least is returned.

    Args:
        chain: the nominal chain.
        q: joint angles (n, d) [rad, m].
        x: measured marker positions (n, 3) [m].
        pose_known: True if the camera pose is that of the chain.
        marker_known: True if the marker position is that of the chain.
        sigma: noise of one coordinate [m], if known: errors within 15 sigma are never called outliers.
        turns: measured orientations of the marker, rotations (n, 3, 3), if any. They only determine the start of the
            fit when neither pose nor marker is known.

    Raises:
        SettingError: sigma is not positive.
        DegenerateDataError: too few pairs, or positions on one line.

    Example:
        >>> import numpy as np
        >>> from kbmaps import RigidChain, align
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> q = np.random.default_rng(0).uniform(-1, 1, (20, 2))
        >>> x = arm.positions(q) + [0.0, 0.0, 1.0]  # the camera stands one metre lower
        >>> align(arm, q, x, pose_known=False, marker_known=True).T_measured_nominal[:3, 3].round(6) + 0.0
        array([0., 0., 1.])
    """
    angles, positions = matching_rows(q, x, chain.joints)
    if sigma is not None:
        require_positive("sigma", sigma)
    pairs = len(angles)
    needed = 1 if pose_known else 3 if marker_known else 4
    if pairs < needed:
        raise DegenerateDataError(
            f"aligning needs at least {needed} pairs when pose_known = {pose_known} and marker_known = {marker_known}, "
            f"got {pairs}; record more"
        )
    poses = chain.poses(angles)
    fit = _Fit(poses[:, :3, :3], poses[:, :3, 3], positions, not pose_known, not marker_known)
    if fit.fit_pose:
        _check_spread(positions, "the measured positions x")
        if marker_known:
            _check_spread(fit.nominal_positions, "the nominal marker positions at q")
    inliers = np.ones(len(angles), dtype=np.bool_)
    if fit.fit_pose and fit.fit_marker:
        fit.shift = _start_shift(fit, sigma or 0.0, None if turns is None else numbers("turns", turns))
    if fit.fit_pose or fit.fit_marker:
        inliers = _fit_robustly(fit, sigma or 0.0)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = fit.rotation, fit.translation
    square = np.square(fit.errors()).sum(axis=1)[inliers]
    inliers.flags.writeable = False
    fitted = chain.with_tool(fit.shift).transformed(transform)
    return Alignment(fitted, frozen(transform), frozen(fit.shift), math.sqrt(float(square.mean())), inliers)


def rigid_motion(points: FloatArray, targets: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the proper rotation (3, 3) and translation (3,) that best map points (n, 3) to targets, in closed form.

    Kabsch 1976, "A solution for the best rotation to relate two sets of vectors".
    """
    share = weights / weights.sum()
    centre_points, centre_targets = share @ points, share @ targets
    covariance = (points - centre_points).T @ ((targets - centre_targets) * share[:, None])
    u, _, vt = np.linalg.svd(covariance)
    handed = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    rotation = vt.T @ handed @ u.T
    return rotation, centre_targets - rotation @ centre_points


def _start_shift(fit: _Fit, sigma: float, turns: FloatArray | None) -> FloatArray:
    """Return the marker shift (3,) whose fit explains a sample of the pairs best.

    Several starting points are tried: pose and marker offset together have local minima, mostly with few joints or
    small ranges.
    """
    chosen = np.unique(np.linspace(0, len(fit.x) - 1, _Settings.start_pairs).astype(np.intp))
    reach = float(np.linalg.norm(fit.x - np.median(fit.x, axis=0), axis=1).mean())
    best, best_spread = np.zeros(3), math.inf
    starts = reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    if turns is not None:
        starts = np.concatenate([_shift_by_turns(fit, turns)[None], starts])
    for start in starts:
        trial = _Fit(fit.nominal_rotations[chosen], fit.nominal_positions[chosen], fit.x[chosen], True, True)
        trial.shift = start
        _fit_robustly(trial, sigma, _Settings.trial_tolerance)
        spread = trial.spread(0.0)
        # A new start must be clearly better, so that rounding does not choose among equals.
        if spread < 0.9 * best_spread - RobustSettings.rounding_m:
            best, best_spread = trial.shift, spread
    return best


def _shift_by_turns(fit: _Fit, turns: FloatArray) -> FloatArray:
    """Return the marker shift (3,) that follows from the marker's orientations (n, 3, 3) and positions.

    With the camera rotated by A and the marker by B on the last frame N, Aᵀ M = N B is linear in A and B. Then x = A (p
    + N δ) + t is linear in the shift δ and the translation t. This solves robot-world/hand-eye calibration (Shah 2013).
    """
    if turns.shape != fit.nominal_rotations.shape:
        raise ShapeError("turns", f"{fit.nominal_rotations.shape} to go with q", turns.shape)
    # Rows: entry (i, k) of Aᵀ M − N B; columns: A's entries (j, i), then B's (j, k).
    design = np.zeros((len(turns), 3, 3, 18))
    for i in range(3):
        for k in range(3):
            design[:, i, k, i:9:3] = turns[:, :, k]
            design[:, i, k, 9 + k :: 3] = -fit.nominal_rotations[:, i, :]
    both = np.linalg.svd(design.reshape(-1, 18), full_matrices=False)[2][-1]
    found = both[:9].reshape(3, 3)
    rotation = nearest_rotation(found * np.sign(np.linalg.det(found)))
    columns = np.concatenate([rotation @ fit.nominal_rotations, np.broadcast_to(np.eye(3), turns.shape)], axis=2)
    target = fit.x - fit.nominal_positions @ rotation.T
    return cast(FloatArray, np.linalg.lstsq(columns.reshape(-1, 6), target.ravel(), rcond=_Settings.rank_tolerance)[0])[
        :3
    ]


def _fit_robustly(fit: _Fit, sigma: float, tolerance: float = _Settings.step_tolerance) -> BoolArray:
    """Fit robustly by graduated non-convexity, then by least squares on the inliers; return the inliers (n,).

    Geman-McClure weights whose scale shrinks from the largest residual to that of the bulk (Yang et al. 2020,
    "Graduated Non-Convexity for Robust Spatial Perception"). The first fits are nearly least squares and do not need a
    good initial guess. `fit` is changed in place.
    """
    weights = np.ones(len(fit.x))
    if fit.fit_pose:
        fit.place(weights)
    norms = fit.norms()
    scale = float(norms.max())
    for _ in range(_Settings.rounds):
        goal = 3.0 * fit.spread(sigma)
        scale = max(scale / 1.4, goal)
        weights = (scale**2 / (scale**2 + norms**2)) ** 2 if scale > 0.0 else weights
        step = fit.improve(weights)
        norms = fit.norms()
        if scale == goal and step < tolerance:
            break
    inliers = np.ones(len(fit.x), dtype=np.bool_)
    for _ in range(_Settings.rounds):
        chosen = norms <= max(RobustSettings.uncalibrated_sigmas * fit.spread(sigma), RobustSettings.rounding_m)
        step = fit.improve(chosen.astype(np.float64))
        norms = fit.norms()
        settled = bool((chosen == inliers).all()) and step < tolerance
        inliers = chosen
        if settled:
            break
    return inliers


def _check_spread(points: FloatArray, what: str) -> None:
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not singular[1] > 1e-6 * max(float(singular[0]), 1e-6):
        raise DegenerateDataError(
            f"{what} lie on one line or in one place, so no pose can be fitted to them; record pairs that spread out"
        )


class PlacedStart:
    """Nominal chain at its best-fitting pose; refitted only when the number of pairs has doubled.

    The pose follows from the first 2^k pairs, so that it does not depend on when it was requested.
    """

    def __init__(self, parameters: ChainParameters, tolerances: ChainTolerances) -> None:
        self._parameters, self._marker_known = parameters, math.isfinite(tolerances.tool)
        known = math.isfinite(tolerances.base_rotation) and math.isfinite(tolerances.base_translation)
        self.needed = not known
        self._change: FloatArray = np.zeros(parameters.size)
        self._placed_at = 0

    def change(self, q: FloatArray, x: FloatArray) -> FloatArray:
        """Return the change (size,) from which to start a fit; 0 while the pairs do not determine a pose.

        Args:
            q: joint values of at least one pair (n, d) [rad, m].
            x: marker positions (n, 3) [m].
        """
        first = 1 << (len(q).bit_length() - 1)
        if self.needed and first != self._placed_at:
            chosen = evenly_spread(first, _Settings.placed)
            self._change, self._placed_at = self._placed(q[chosen], x[chosen]), first
        return self._change

    def _placed(self, q: FloatArray, x: FloatArray) -> FloatArray:
        parameters, change = self._parameters, np.zeros(self._parameters.size)
        try:
            placed = align(parameters.reference, q, x, pose_known=False, marker_known=self._marker_known)
        except DegenerateDataError:
            return change
        change[parameters.base_turn] = rotation_vector(placed.T_measured_nominal[:3, :3])
        change[parameters.base_shift] = placed.T_measured_nominal[:3, 3]
        change[parameters.tool] = placed.marker_shift
        return change


def with_refitted_tool(
    kbmap: KBMap, chain: RigidChain, q: ArrayLike, x: ArrayLike, sigma: float | None = None
) -> KBMap:
    """Return the map after its marker was moved to another place on the last link, or the tool was changed.

    The offset δ is fitted robustly to the pairs since then: x ≈ f(q) + R(q) δ with the orientation R of the nominal
    chain. With E the nets of R it is built in exactly, G ← G + E δ. Errors of R itself are left to a learner.

    Args:
        kbmap: the map learnt before the change; of its outputs only the position changes.
        chain: the nominal chain, which supplies the orientations.
        q, x: pairs since the change, (n, d) [rad, m] and (n, 3) [m].
        sigma: noise of one coordinate [m], if known.

    Raises:
        ShapeError, NonFiniteError, SettingError (a sigma that is not positive), DegenerateDataError (no pairs)
    """
    angles, positions, _ = checked_pairs(q, x, sigma, chain.joints)
    if not len(angles):
        raise DegenerateDataError("a marker's move needs at least 1 pair seen since; record more")
    oriented = KBMap(kbmap.bases, np.concatenate([kbmap.net[:POSITION_OUTPUTS], chain.orientation_maps(kbmap.bases)]))
    errors = positions - oriented.predict(angles)
    # R is a rotation: its transpose takes each pair's error to an estimate of δ, with the same noise.
    offsets = (chain.orientation(angles).swapaxes(1, 2) @ errors[..., None])[..., 0]
    net = kbmap.net.copy()
    net[:POSITION_OUTPUTS] = oriented.with_tool(_robust_mean(offsets, sigma or 0.0)).net[:POSITION_OUTPUTS]
    return KBMap(kbmap.bases, net, kbmap.metadata)


def _robust_mean(offsets: FloatArray, sigma: float) -> FloatArray:
    """Return the mean (3,) of offsets (n, 3) without outliers.

    It starts from their median, so that up to half of them may be arbitrary. Fewer than five have no majority; all of
    them count.
    """
    centre = np.median(offsets, axis=0)
    for _ in range(len(offsets)):
        distances = np.linalg.norm(offsets - centre, axis=1)
        # An offset always explains a single pair.
        spread = max(middle_sigma(distances, len(distances) // 2 + 1), sigma)
        near = distances <= RobustSettings.rounding_m + RobustSettings.uncalibrated_sigmas * spread
        mean = offsets[near].mean(axis=0)
        if (mean == centre).all():
            break
        centre = mean
    return centre
