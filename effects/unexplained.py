"""Hold a learnt map from joint readings to a shift of the measurements, for errors that no effect explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.suggest import did_you_mean
from kbmaps import KBMap, KBMapsError, KernelLearner, ModelFormatError, ResidualModel, TensorTrain

PLACE = ("marker.x", "marker.y", "marker.z")  # coordinates of the marker, in place of a joint


class StoredModel(Protocol):
    """A KB-Map that predicts and can be stored."""

    @property
    def joints(self) -> int: ...

    def predict(self, q: ArrayLike) -> FloatArray:
        """Return outputs (n, 3) at q (n, d)."""
        ...

    def to_bytes(self) -> bytes: ...


_READERS: tuple[Callable[[bytes], StoredModel], ...] = (
    KBMap.from_bytes,
    TensorTrain.from_bytes,
    KernelLearner.from_bytes,
    ResidualModel.from_bytes,
)


@dataclass(frozen=True, eq=False)
class Unexplained:
    """A model of the errors that no effect explains."""

    model: StoredModel  # any KB-Map; its outputs are shifts of the measurements [m], in the measurement frame
    # joints whose readings are its inputs, in order; among them may be `PLACE`, the marker's coordinates [m] by the
    # described robot at the readings
    joints: tuple[str, ...]
    factors: tuple[float, ...]  # factor on each of these inputs
    robot: RobotDescription  # the robot of these joints

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        model: StoredModel,
        joints: tuple[str, ...],
        factors: tuple[float, ...] | None = None,
    ) -> Unexplained:
        """Create the model over these joints of a robot.

        Args:
            factors: factor on each reading, one per joint; 1 by default. So a joint can appear twice, for instance with
                its double angle.

        Raises:
            RobotError: a joint is unknown, or named twice with the same factor, or the model has another number of
                joints, or has learnt nothing.
        """
        for joint in joints:
            if joint not in (*robot.joints, *PLACE):
                raise RobotError(f"{joint!r}: no joint of this robot", remedy=did_you_mean(joint, robot.joints))
        factors = (1.0,) * len(joints) if factors is None else factors
        if len(factors) != len(joints):
            raise RobotError(f"{len(factors)} factors for {len(joints)} joints", remedy="Give one for each joint")
        if not np.isfinite(factors).all():
            raise RobotError("a factor is not finite")
        if len(set(zip(joints, factors, strict=True))) != len(joints):
            raise RobotError("a joint is named twice", remedy="Name each once, or with other factors")
        if model.joints != len(joints):
            raise RobotError(
                f"the model takes {model.joints} joints, not {len(joints)}", remedy="Name those that it was learnt over"
            )
        try:
            model.predict(np.zeros((1, len(joints))))
        except KBMapsError as error:
            raise RobotError(f"the model cannot predict: {error}", remedy="Store one that has learnt") from error
        return cls(model, joints, factors, robot)

    @property
    def is_of_place(self) -> bool:
        """True if an input is a coordinate of the marker."""
        return bool(set(self.joints) & set(PLACE))

    def predict(self, q: FloatArray) -> FloatArray:
        """Return shifts (n, 3) [m] at the readings q (n, d) [rad, m] of all joints."""
        values = q
        if self.is_of_place:
            values = np.concatenate([q, self.robot.chain.positions(q)], axis=1)
        names = (*self.robot.joints, *PLACE)
        return self.model.predict(values[:, [names.index(joint) for joint in self.joints]] * self.factors)


def stored_model(data: bytes) -> StoredModel:
    """Read the map in `data`, of any kind.

    Raises:
        ModelFormatError: the data is damaged, or not a map that predicts by itself.
    """
    for reader in _READERS:
        try:
            return reader(data)
        except ModelFormatError:
            continue
    raise ModelFormatError("not a map of kbmaps that predicts by itself, or damaged")
