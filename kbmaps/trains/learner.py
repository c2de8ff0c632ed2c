"""Learner of a tensor train, from all pairs at once or from a stream."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from kbmaps import lapack
from kbmaps.arrays import BoolArray, FloatArray, require_positive, rows, rows_or_vector, vector
from kbmaps.chains.chain import RigidChain
from kbmaps.errors import DegenerateDataError, ModelFormatError, SettingError, ShapeError
from kbmaps.maps.basis import JointBasis, describe_bases, parse_bases
from kbmaps.maps.stack import BasisStack
from kbmaps.model import Estimate, Model, near_data
from kbmaps.packed import complete, count, flag, named, number, pack, restoring, unpack
from kbmaps.pairs import checked_pairs, stored_pairs
from kbmaps.trains.core_prior import CORE_NUMBERS, CoreFamily, CorePrior
from kbmaps.trains.fit import TensorProblem, whitened_jacobian
from kbmaps.trains.posterior import TensorPosterior, misfit_sizes
from kbmaps.trains.search import Fit, Pairs, SearchSettings, information, refine, search
from kbmaps.trains.train import TensorSettings, TensorTrain, parse_settings


def core_equations(problem: TensorProblem, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return J (3 n, 36 d) and y (3 n,) of a problem linearised at z.

    y = J c + e for cores c (36 d,), with e ~ N(0, I).
    """
    prior = problem.prior
    plain = CorePrior(prior.mean, np.tile(np.eye(CORE_NUMBERS), (prior.joints, 1, 1)))
    jacobian = whitened_jacobian(problem.weights, problem.maps(z), plain) / np.repeat(problem.std, 3)[:, None]
    residuals = (problem.residuals(z) / problem.std[:, None]).ravel()
    return jacobian, residuals + jacobian @ prior.cores(z).ravel()


def likely_ellipse_std(family: CoreFamily, jacobian: FloatArray, positions: FloatArray) -> float:
    """Return the most probable of `_Settings.ellipse_stds`, for pairs linearised at a fit to them.

    With c = m + S z, z ~ N(0, I), y - J m = r and z marginalised,

        2 log p = - rᵀ (I + J S Sᵀ Jᵀ)⁻¹ r - log |I + J S Sᵀ Jᵀ| + terms without S,

    or, if the cores have fewer numbers than there are coordinates,

        2 log p = rᵀ J S (I + Sᵀ Jᵀ J S)⁻¹ Sᵀ Jᵀ r - log |I + Sᵀ Jᵀ J S| + terms without S.

    Args:
        family: the priors to choose from.
        jacobian, positions: J (3 n, 36 d) and y (3 n,) of `core_equations`.
    """
    residuals = positions - jacobian @ family.mean.ravel()
    few = len(jacobian) < jacobian.shape[1]
    evidences = _by_coordinates(family, jacobian, residuals) if few else _by_cores(family, jacobian, residuals)
    scores = [
        evidence - 0.5 * (math.log(std / _Settings.usual_ellipse_std) / math.log(10.0)) ** 2
        for std, evidence in zip(_Settings.ellipse_stds, evidences, strict=True)
    ]
    return _Settings.ellipse_stds[int(np.argmax(scores))]


def _by_coordinates(family: CoreFamily, jacobian: FloatArray, residuals: FloatArray) -> list[float]:
    """Return the log evidence of each of `_Settings.ellipse_stds`, from matrices of the size of the coordinates.

    S Sᵀ is the rigid part plus the square of each standard deviation times the rest.
    """
    joints = len(family.mean)
    blocks = jacobian.reshape(-1, joints, CORE_NUMBERS).swapaxes(0, 1)
    moved = (blocks @ family.motions).swapaxes(0, 1).reshape(len(jacobian), -1)
    own = jacobian * np.tile(family.sizes, joints)
    rigid, rest = np.eye(len(jacobian)) + moved @ moved.T, own @ own.T
    evidences: list[float] = []
    for std in _Settings.ellipse_stds:
        square, log_determinant = _inverse_square(rigid + std**2 * rest, residuals)
        evidences.append(-0.5 * (square + log_determinant))
    return evidences


def _by_cores(family: CoreFamily, jacobian: FloatArray, residuals: FloatArray) -> list[float]:
    joints, size = len(family.mean), jacobian.shape[1]
    blocks = (jacobian.T @ jacobian).reshape(joints, CORE_NUMBERS, joints, CORE_NUMBERS)
    slope = (jacobian.T @ residuals).reshape(joints, CORE_NUMBERS, 1)
    evidences: list[float] = []
    for std in _Settings.ellipse_stds:
        spread = family.prior(std).spread
        whitened = np.einsum("aij,aibk,bkl->ajbl", spread, blocks, spread, optimize=True).reshape(size, size)
        pull = (spread.swapaxes(1, 2) @ slope).ravel()
        square, log_determinant = _inverse_square(whitened + np.eye(size), pull)
        evidences.append(0.5 * (square - log_determinant))
    return evidences


def _inverse_square(matrix: FloatArray, vector: FloatArray) -> tuple[float, float]:
    """Return vᵀ M⁻¹ v and log |M|, which is infinite if M is not positive definite up to rounding."""
    factor, positive = lapack.cholesky_lower(np.asfortranarray(matrix))
    if not positive:
        return 0.0, math.inf
    return float(vector @ lapack.cholesky_solve(factor, vector)), 2.0 * float(np.log(np.diag(factor)).sum())


KIND = "tensor learner, 3"
_FIELDS = ("bases", "settings", "pairs", "waiting", "searches", "length")
_FITTED = ("z", "sure", "used", "information", "absorbed")


class _Settings:
    first_noise: float = 0.1  # initial noise of the first fit around a prior, relative to the residuals under the prior
    # A refit with this many times the noise of the fit before has diverged, and the search starts again.
    lost: float = 3.0
    share_before_refit: int = 4
    # Multiples of the minimum number of pairs for a train: to start a search, and to stop repeating it.
    pairs_to_search: float = 1.5
    searches_until: float = 1.5
    # Candidates, and the centre of the prior over them: a few parts in a thousand, within about a decade.
    ellipse_stds = tuple(float(std) for std in np.geomspace(1e-4, 3e-2, 11))
    usual_ellipse_std: float = 0.003


class TensorLearner(Model):
    """Learner of a TensorTrain.

    With a prior, every fit is the most likely train under it (`TensorLearner.around` makes one from a nominal chain).
    Without, the first fits search from random chains once there are `pairs_needed`; later ones continue from the one
    before. If no sigma is given, the noise is estimated from the residuals.

    Args:
        bases: one per joint; orthonormal over the joints' ranges (`learning_bases`) are advised.
        prior: prior of the cores, in these bases; None without one. Of a family, every fit selects the member that its
            pairs support.
        settings: settings of the learner; None for the defaults.

    Raises:
        ShapeError: the prior has another number of joints.

    Example:
        >>> import numpy as np
        >>> from kbmaps import RigidChain, TensorLearner, learning_bases
        >>> fixed = np.tile(np.eye(4), (3, 1, 1))
        >>> fixed[1:, 0, 3] = 0.3, 0.2  # links [m]
        >>> arm = RigidChain(fixed, axes=[[0, 0, 1], [0, 1, 0]], prismatic=[False, False])
        >>> learner = TensorLearner(learning_bases([-1, -1], [1, 1]))
        >>> q = np.random.default_rng(0).uniform(-1, 1, (40, 2))
        >>> learner.learn(q, arm.positions(q))
        >>> bool(np.abs(learner.predict(q) - arm.positions(q)).max() < 1e-9)
        True
    """

    def __init__(
        self,
        bases: Sequence[JointBasis],
        prior: CorePrior | CoreFamily | None = None,
        settings: TensorSettings | None = None,
    ) -> None:
        self.bases = tuple(bases)
        self.settings = TensorSettings() if settings is None else settings
        self._stack = BasisStack(self.bases)
        self._q = np.empty((0, self.joints))
        self._x = np.empty((0, 3))
        self._sigma = np.empty(0)
        self._pairs = self._waiting = 0
        self._searches = prior is None
        self._prior: CorePrior | None = None
        self._fit: Fit | None = None
        self._train: TensorTrain | None = None
        self._posterior: TensorPosterior | None = None
        self._family: CoreFamily | None = None
        if isinstance(prior, CoreFamily):
            self.rebase(prior.prior(_Settings.usual_ellipse_std))
            self._family = prior
        elif prior is not None:
            self.rebase(prior)

    @classmethod
    def around(
        cls,
        chain: RigidChain,
        bases: Sequence[JointBasis],
        settings: TensorSettings | None = None,
        *,
        turn_std: float = math.radians(3.0),
        shift_std: float = 0.015,
        marker_std: float = 0.03,
        ellipse_std: float | None = None,
    ) -> TensorLearner:
        """Return a learner with a nominal chain as prior; the standard deviations as in `CorePrior.around`.

        Args:
            chain: the nominal chain.
            bases: one per joint.
            settings: of the learner; the defaults if None.
            turn_std: of each component of a link's rotation [rad].
            shift_std: of each component of a link's shift, at the joint [m].
            marker_std: of each component of the marker's position [m].
            ellipse_std: the arm's deviation from rigidity; None estimates it by the evidence of the pairs at every fit.

        Raises:
            SettingError: a standard deviation is not positive.
            BasisError: bases do not fit the chain.
        """
        length = max(float(np.linalg.norm(chain.fixed[:, :3, 3], axis=1).mean()), 1e-3)
        family = CoreFamily.around(
            chain, bases, turn_std=turn_std, shift_std=shift_std, marker_std=marker_std, length=length
        )
        return cls(bases, family if ellipse_std is None else family.prior(ellipse_std), settings)

    @property
    def joints(self) -> int:
        return len(self.bases)

    @property
    def pairs(self) -> int:
        return self._pairs

    @property
    def kept(self) -> int:
        """Number of pairs in the window."""
        return len(self._q)

    @property
    def pairs_needed(self) -> int:
        """Minimum number of pairs for the first fit without a prior: 1.5 times one third of the free parameters.

        The train has Σ 12 m_k numbers over all joints but the last and 3 m_d of that, minus 12 for the frame between
        any two cores: 24 d − 15 for revolute joints.
        """
        sizes = [basis.size for basis in self.bases]
        numbers = 12 * sum(sizes[:-1]) + 3 * sizes[-1] - 12 * (self.joints - 1)
        return math.ceil(_Settings.pairs_to_search * numbers / 3)

    @property
    def train(self) -> TensorTrain:
        """Train of the last fit.

        Raises:
            DegenerateDataError: there is no prior, and fewer than `pairs_needed` pairs so far.
        """
        if self._train is None:
            raise DegenerateDataError(
                f"without a prior a train of {self.joints} joints needs {self.pairs_needed} pairs; "
                f"{self.kept} are kept, {self._waiting} of them wait for the next fit"
            )
        return self._train

    @property
    def noise(self) -> float | None:
        """Noise of a coordinate at the last fit [m]: estimated, or the RMS of the given sigmas; None before."""
        return None if self._fit is None else self._fit.noise

    @property
    def outliers(self) -> BoolArray:
        """True for each pair of the last fit, oldest first, that was left out as an outlier."""
        return np.zeros(0, dtype=np.bool_) if self._fit is None else ~self._fit.used

    def learn(self, q: ArrayLike, x: ArrayLike, sigma: ArrayLike | None = None) -> None:
        angles, positions, sigmas = checked_pairs(q, x, sigma, self.joints)
        self._q = np.concatenate([self._q, angles])
        self._x = np.concatenate([self._x, positions])
        self._sigma = np.concatenate([self._sigma, sigmas])
        self._pairs += len(angles)
        self._waiting += len(angles)
        if self.settings.window is not None:
            self._keep(self.settings.window)
        # While pairs are few, a quarter more may change a lot.
        if self._waiting >= min(self.settings.refit_every, max(1, self.kept // _Settings.share_before_refit)):
            self.refit()

    def forget(self, keep: int) -> None:
        """Drop all but the last `keep` pairs. The train stays until the next fit.

        Raises:
            SettingError: keep below 0.
        """
        if keep < 0:
            raise SettingError(f"keep must be at least 0, got {keep}")
        self._keep(keep)

    def tool_changed(self, tolerance: float) -> None:
        """Allow for a marker that was moved: keep the posterior of all other cores, and forget the pairs.

        The current train becomes the prior's mean. Each core's covariance is the one with the others fixed, which pins
        the frames between them. The last core is as free as a marker moved by the tolerance: along the axes of its
        frame if a nominal chain gave them, otherwise in any direction.

        Args:
            tolerance: 1-sigma of each component of the displacement [m].

        Raises:
            SettingError: the tolerance is not positive.
            DegenerateDataError: there is neither a prior nor enough pairs.
        """
        require_positive("tolerance", tolerance, unit=" m")
        prior = self.posterior.with_other_tool(tolerance)
        self._keep(0)
        self.rebase(prior)

    def rebase(self, prior: CorePrior) -> None:
        """Replace the prior for the same pairs; the next fit starts from its mean.

        Raises:
            ShapeError: it has another number of joints.
        """
        if prior.joints != self.joints:
            raise ShapeError("prior.mean", f"({self.joints}, {CORE_NUMBERS})", prior.mean.shape)
        self._prior, self._searches = prior, False
        self._fit = self._posterior = self._family = None
        self._train = TensorTrain(self.bases, prior.cores(np.zeros(CORE_NUMBERS * self.joints)))
        self._waiting = self.kept

    def refit(self) -> None:
        """Fit to all kept pairs now; without a prior only once there are `pairs_needed` of them."""
        if self.kept < (self.pairs_needed if self._searches else 1):
            return
        data = Pairs(self._stack.joint_weights(self._q), self._x, self._sigma)
        fit = self._with_likely_prior(data, self._fitted(data))
        prior = self._known_prior()
        self._fit, self._train, self._waiting = fit, TensorTrain(self.bases, prior.cores(fit.z)), 0
        known, std = information(data, prior, fit)
        self._posterior = TensorPosterior(self._train, prior, known, noise=fit.noise)
        used = self._q[fit.used]
        self._posterior.set_residuals(used, self._x[fit.used] - self.predict(used), std)

    @property
    def posterior(self) -> TensorPosterior:
        """Posterior of the train at the last fit; the prior before.

        Raises:
            DegenerateDataError: there is neither a prior nor enough pairs.
        """
        if self._posterior is None:
            self._posterior = TensorPosterior(self.train, self._known_prior(), None)
        return self._posterior

    def predict(self, q: ArrayLike) -> FloatArray:
        return self.train.predict(q)

    def jacobian(self, q: ArrayLike) -> FloatArray:
        return self.train.jacobian(q)

    def estimate(self, q: ArrayLike) -> Estimate:
        """Return positions with the standard deviation of the Gauss-Newton posterior.

        If residuals reveal joint or instrument errors that no train can follow, their uncertainty is added.
        """
        angles = rows_or_vector("q", q, self.joints)
        batch = np.atleast_2d(angles)
        variance = self.posterior.variance(batch)
        inside = near_data(variance, self.posterior.widest)
        return Estimate(self.predict(batch), np.sqrt(variance), inside).like(angles)

    def to_bytes(self) -> bytes:
        arrays = {"q": self._q, "x": self._x, "sigma": self._sigma}
        if self._prior is not None:
            arrays |= {"mean": self._prior.mean, "spread": self._prior.spread}
        if self._family is not None:
            arrays |= {"family_mean": self._family.mean, "motions": self._family.motions}
        known = None if self._posterior is None else self._posterior.information
        if self._fit is not None and self._posterior is not None and known is not None:
            used = self._fit.used.astype(np.float64)
            sure = np.array([self._fit.noise, self._posterior.widest, *self._posterior.misfit])
            arrays |= {"z": self._fit.z, "sure": sure, "used": used, "information": known}
            arrays |= {"absorbed": self._posterior.absorbed}
        content = {
            "bases": describe_bases(self.bases),
            "settings": asdict(self.settings),
            "pairs": self._pairs,
            "waiting": self._waiting,
            "searches": self._searches,
            "length": 0.0 if self._family is None else self._family.length,
        }
        return pack(KIND, content, arrays)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        content, arrays = unpack(data, KIND)
        with restoring("a tensor learner"):
            named(content, "the fields", _FIELDS)
            complete(arrays, ("q", "x", "sigma"), ("mean", "spread"), ("family_mean", "motions"), _FITTED)
            return cls._restored(content, arrays)

    @classmethod
    def _restored(cls, content: dict[str, Any], arrays: dict[str, FloatArray]) -> Self:
        prior = CorePrior(arrays["mean"], arrays["spread"]) if "mean" in arrays else None
        learner = cls(parse_bases(content["bases"]), prior, parse_settings(content["settings"]))
        learner._q, learner._x, learner._sigma = stored_pairs(arrays, learner.joints)
        learner._pairs, learner._waiting = count(content["pairs"], "pairs"), count(content["waiting"], "waiting")
        if not learner._waiting <= learner.kept <= learner._pairs:
            raise ModelFormatError(f"of {learner._pairs} pairs {learner.kept} are kept and {learner._waiting} wait")
        learner._searches = flag(content["searches"], "the field searches")
        if prior is None and not (learner._searches and set(arrays) == {"q", "x", "sigma"}):
            raise ModelFormatError("a learner that has no prior yet cannot have fitted, and has to search")
        if prior is not None and "z" in arrays:
            learner._restore_fit(prior, arrays)
        if "motions" in arrays:
            length = number(content["length"], "the field length")
            learner._family = CoreFamily(arrays["family_mean"], arrays["motions"], length)
            _of_rows("family_mean", arrays["family_mean"], learner.joints, CORE_NUMBERS)
        return learner

    def _restore_fit(self, prior: CorePrior, arrays: Mapping[str, FloatArray]) -> None:
        size = CORE_NUMBERS * self.joints
        z, used = vector("z", arrays["z"], size), arrays["used"]
        noise, least_sure, *misfit = (float(value) for value in vector("sure", arrays["sure"], 5))
        if used.ndim != 1 or not np.isin(used, (0.0, 1.0)).all() or not noise > 0.0:
            raise ModelFormatError("it is not said which pairs a fit used, or it has no noise")
        self._fit = Fit(z, noise, used.astype(np.bool_))
        self._train = TensorTrain(self.bases, prior.cores(z))
        known = _of_rows("information", arrays["information"], size, size)
        self._posterior = TensorPosterior(self._train, prior, known, noise=noise)
        absorbed = _of_rows("absorbed", arrays["absorbed"], size, sum(misfit_sizes(self.joints)))
        self._posterior.restore(np.array(misfit), absorbed, least_sure)

    def _keep(self, count: int) -> None:
        begin = max(len(self._q) - count, 0)
        self._q, self._x, self._sigma = self._q[begin:], self._x[begin:], self._sigma[begin:]
        self._waiting = min(self._waiting, len(self._q))

    def _known_prior(self) -> CorePrior:
        if self._prior is None:
            raise DegenerateDataError("there is no prior yet; learn more pairs")
        return self._prior

    def _with_likely_prior(self, data: Pairs, fit: Fit) -> Fit:
        """Return the fit under the member of the family that the pairs support."""
        if self._family is None:
            return fit
        prior = self._known_prior()
        problem = data.chosen(fit.used).problem(prior, fit.noise)
        std = likely_ellipse_std(self._family, *core_equations(problem, fit.z))
        self._prior = self._family.prior(std)
        if np.array_equal(self._prior.spread, prior.spread):
            return fit
        z = self._prior.whitened(prior.cores(fit.z))
        return refine(data, self._prior, z, fit.noise, robust=self.settings.robust)

    def _fitted(self, data: Pairs) -> Fit:
        """Return the fit to all kept pairs; give a learner without a prior a vague one of the pairs' size."""
        rng = np.random.default_rng(self.settings.seed)
        if self._prior is None:
            self._prior = CorePrior.vague(self.joints, data.size / math.sqrt(self.joints))
        before, robust = self._fit, self.settings.robust
        if before is None and not self._searches:
            z = np.zeros(CORE_NUMBERS * self.joints)
            guess = _Settings.first_noise * math.sqrt(
                float(np.square(data.problem(self._prior, 1.0).residuals(z)).mean())
            )
            return refine(data, self._prior, z, max(guess, data.noise_floor), robust=robust)
        if before is None or (self._searches and self.kept < _Settings.searches_until * self.pairs_needed):
            return search(data, self._prior, self.bases, rng, self.settings.starts, robust=robust)
        fit = refine(data, self._prior, before.z, before.noise, robust=robust)
        most = min(_Settings.lost * max(before.noise, data.noise_floor), SearchSettings.plausible * data.size)
        lost = fit.noise > most
        if self._searches and lost:
            again = search(data, self._prior, self.bases, rng, self.settings.starts, robust=robust)
            fit = min(fit, again, key=lambda candidate: candidate.noise)
        return fit


def _of_rows(name: str, values: FloatArray, length: int, width: int) -> FloatArray:
    """Return finite `values` of shape (length, width). Raises ShapeError, NonFiniteError."""
    if len(values) != length:
        raise ShapeError(name, f"({length}, {width})", values.shape)
    return rows(name, values, width)
