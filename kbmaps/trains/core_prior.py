"""Prior of a tensor train's cores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kbmaps.arrays import FloatArray, frozen
from kbmaps.chains.chain import RigidChain
from kbmaps.errors import NonFiniteError, SettingError, ShapeError
from kbmaps.maps.basis import JointBasis
from kbmaps.rotations import cross_matrix
from kbmaps.trains.train import TensorTrain

CORE_NUMBERS = 36
_MOTIONS = 9  # six of a link and three of the marker


@dataclass(frozen=True, eq=False)
class CorePrior:
    """Independent Gaussians over the cores: core k = mean_k + spread_k z_k with z_k ~ N(0, I).

    Attributes:
        mean: (d, 36), the cores in C order.
        spread: (d, 36, 36), a square root of each core's covariance.
    """

    mean: FloatArray
    spread: FloatArray

    def __post_init__(self) -> None:
        mean, spread = frozen(self.mean), frozen(self.spread)
        if mean.ndim != 2 or mean.shape[1] != CORE_NUMBERS:
            raise ShapeError("mean", f"(d, {CORE_NUMBERS})", mean.shape)
        if spread.shape != (len(mean), CORE_NUMBERS, CORE_NUMBERS):
            raise ShapeError("spread", f"({len(mean)}, {CORE_NUMBERS}, {CORE_NUMBERS})", spread.shape)
        _set_finite(self, mean=mean, spread=spread)

    @classmethod
    def vague(cls, joints: int, length: float, std: float = 1.0) -> CorePrior:
        """Return a prior of known size only: mean 0, every number of std `std`, translations `std`·length [m]."""
        sizes = std * np.tile([1.0, 1.0, 1.0, length], 9)
        return cls(np.zeros((joints, CORE_NUMBERS)), np.tile(np.diag(sizes), (joints, 1, 1)))

    @classmethod
    def around(
        cls,
        chain: RigidChain,
        bases: Sequence[JointBasis],
        *,
        turn_std: float,
        shift_std: float,
        marker_std: float,
        ellipse_std: float,
        length: float,
    ) -> CorePrior:
        """Return the prior of a nominal chain with uncertain links, which is not quite rigid.

        To first order, a small rigid motion before joint k changes its core along six directions, and a shift of the
        marker changes the last core along three. They carry the geometry's uncertainty. In addition, every number of
        every core has an independent `ellipse_std`, for deviations that no rigid chain can have.

        Args:
            chain: the nominal model.
            bases: one per joint.
            turn_std: standard deviation of each component of a link's rotation [rad].
            shift_std: of each component of a link's shift, at the joint [m].
            marker_std: of each component of the marker's position [m].
            ellipse_std: of each number of a core; of a translation, times `length`.
            length: length of a typical link [m].

        Raises:
            SettingError: a standard deviation or the length is not positive.
            BasisError: bases do not fit the chain.
        """
        family = CoreFamily.around(
            chain, bases, turn_std=turn_std, shift_std=shift_std, marker_std=marker_std, length=length
        )
        return family.prior(ellipse_std)

    @property
    def joints(self) -> int:
        """Number of joints d."""
        return len(self.mean)

    def cores(self, z: FloatArray) -> FloatArray:
        """Return the cores (d, 3, 3, 4) at z (36 d,)."""
        moved = self.mean + (self.spread @ z.reshape(self.joints, CORE_NUMBERS, 1))[:, :, 0]
        return moved.reshape(self.joints, 3, 3, 4)

    def whitened(self, cores: FloatArray) -> FloatArray:
        """Return the z (36 d,) of cores (d, 3, 3, 4)."""
        off = cores.reshape(self.joints, CORE_NUMBERS, 1) - self.mean[:, :, None]
        z: FloatArray = np.linalg.solve(self.spread, off).astype(np.float64, copy=False)
        return z.ravel()


@dataclass(frozen=True, eq=False)
class CoreFamily:
    """Priors around one nominal chain that differ in the expected deviation from rigidity.

    Attributes:
        mean: (d, 36), the cores of the nominal chain.
        motions: (d, 36, m), changes of a core by rigid motions of its link, each of one standard deviation.
        length: length of a typical link [m].
    """

    mean: FloatArray
    motions: FloatArray
    length: float

    def __post_init__(self) -> None:
        mean, motions = frozen(self.mean), frozen(self.motions)
        if mean.ndim != 2 or mean.shape[1] != CORE_NUMBERS:
            raise ShapeError("mean", f"(d, {CORE_NUMBERS})", mean.shape)
        if motions.ndim != 3 or motions.shape[:2] != mean.shape:
            raise ShapeError("motions", f"({len(mean)}, {CORE_NUMBERS}, m)", motions.shape)
        _set_finite(self, mean=mean, motions=motions)

    @classmethod
    def around(
        cls,
        chain: RigidChain,
        bases: Sequence[JointBasis],
        *,
        turn_std: float,
        shift_std: float,
        marker_std: float,
        length: float,
    ) -> CoreFamily:
        """Return the family of `CorePrior.around`.

        Raises:
            SettingError: a standard deviation or the length is not positive.
            BasisError: bases do not fit the chain.
        """
        settings = {"turn_std": turn_std, "shift_std": shift_std, "marker_std": marker_std, "length": length}
        for name, value in settings.items():
            if not value > 0.0:
                raise SettingError(f"{name} must be greater than 0, got {value!r}")
        train = TensorTrain.from_chain(chain, bases)
        motions = np.zeros((chain.joints, CORE_NUMBERS, _MOTIONS))
        for k in range(chain.joints):
            directions = _motions(train.cores[k], chain.fixed[k, :3, 3], bases[k], turn_std, shift_std)
            if k == chain.joints - 1:
                directions += [marker_std * motion.ravel() for motion in _marker_shifts(train.cores[k])]
            motions[k, :, : len(directions)] = np.column_stack(directions)
        return cls(train.cores.reshape(chain.joints, CORE_NUMBERS), motions, length)

    @property
    def sizes(self) -> FloatArray:
        """Unit of each number of a core (36,): 1, or for translations `length`."""
        return np.tile([1.0, 1.0, 1.0, self.length], 9)

    def prior(self, ellipse_std: float) -> CorePrior:
        """Return the prior with an independent `ellipse_std` for each number of a core, times `length` in translations.

        Raises:
            SettingError: ellipse_std is not positive.
        """
        if not ellipse_std > 0.0:
            raise SettingError(f"ellipse_std must be greater than 0, got {ellipse_std!r}")
        covariances = self.motions @ self.motions.swapaxes(1, 2) + np.diag(np.square(ellipse_std * self.sizes))
        spread: FloatArray = np.linalg.cholesky(covariances).astype(np.float64, copy=False)
        return CorePrior(self.mean, spread)


def _set_finite(prior: CorePrior | CoreFamily, **arrays: FloatArray) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise NonFiniteError(name)
        object.__setattr__(prior, name, array)


def _motions(
    core: FloatArray, joint_place: FloatArray, basis: JointBasis, turn_std: float, shift_std: float
) -> list[FloatArray]:
    """Return changes (36,) of a core (3, 3, 4) by rotations about and shifts of the joint, each of one std."""
    constant = np.zeros(3)
    constant[: basis.size] = np.linalg.solve(basis.matrix, np.eye(basis.size)[0])
    changes: list[FloatArray] = []
    for axis in np.eye(3):
        turn = cross_matrix(axis)
        moved = turn @ core
        moved[:, :, 3] -= constant[:, None] * (turn @ joint_place)
        changes.append(turn_std * moved.ravel())
        shift = np.zeros((3, 3, 4))
        shift[:, :, 3] = constant[:, None] * axis
        changes.append(shift_std * shift.ravel())
    return changes


def _marker_shifts(core: FloatArray) -> list[FloatArray]:
    """Return changes (3, 3, 4) of the last core when the marker moves by 1 m along each of its frame's axes."""
    changes: list[FloatArray] = []
    for column in range(3):
        change = np.zeros((3, 3, 4))
        change[:, :, 3] = core[:, :, column]
        changes.append(change)
    return changes
