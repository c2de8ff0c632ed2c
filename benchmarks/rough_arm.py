"""A rough nominal arm of five to seven joints, and its true counterpart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.humanoid_arm import nominal_chain
from kbmaps import ChainParameters, ChainTolerances, RigidChain
from kbmaps.arrays import FloatArray

ROUGH = ChainTolerances(axes=np.radians(3.0), points=0.015, tool=0.03)


@dataclass(frozen=True)
class RoughArm:
    """A nominal model, the true arm as a change of its parameters, and pairs of the true arm."""

    parameters: ChainParameters
    change: FloatArray

    @property
    def drawing(self) -> RigidChain:
        return self.parameters.reference

    def positions(self, q: FloatArray) -> FloatArray:
        return self.parameters.positions(self.change, q)

    def angles(
        self, n: int, reach_deg: float, rng: np.random.Generator, centre_deg: FloatArray | float = 0.0
    ) -> FloatArray:
        """Return random configurations (n, d) [rad], uniform within a reach of the centre."""
        return np.radians(centre_deg + rng.uniform(-reach_deg, reach_deg, (n, self.drawing.joints)))

    def measured(self, q: FloatArray, sigma: float, rng: np.random.Generator) -> FloatArray:
        return self.positions(q) + sigma * rng.normal(size=(len(q), 3))


def rough_arm(joints: int, rng: np.random.Generator, tolerances: ChainTolerances = ROUGH) -> RoughArm:
    """Return the humanoid arm without its last joints, with a nominal model that errs within `tolerances`.

    The nominal arm is not ideal either: every link is rotated by 0.02 rad and shifted by 5 mm (standard deviations of
    each component), so that no two axes meet.
    """
    ideal = nominal_chain()
    fixed = ideal.fixed[: joints + 1].copy()
    for transform in ideal.fixed[joints + 1 :]:
        fixed[-1] = fixed[-1] @ transform
    plain = ChainParameters(RigidChain(fixed, ideal.axes[:joints], ideal.prismatic[:joints]))
    made = plain.standard_deviations(ChainTolerances(axes=0.02, points=0.005)) * rng.normal(size=plain.size)
    drawing = ChainParameters(plain.chain(made))
    return RoughArm(drawing, drawing.standard_deviations(tolerances) * rng.normal(size=drawing.size))


def least_error(
    arm: RoughArm,
    q: FloatArray,
    sigma: float,
    test: FloatArray,
    rng: np.random.Generator,
    tolerances: ChainTolerances = ROUGH,
) -> float:
    """Return the mean error [m] at `test` of the right model's posterior, with the right prior, linearised at truth."""
    std = arm.parameters.standard_deviations(tolerances)
    free = std > 0.0
    _, jacobian = arm.parameters.linearised(arm.change, q)
    design = (jacobian[:, :, free] * std[free]).reshape(3 * len(q), -1) / sigma
    precision = design.T @ design + np.eye(design.shape[1])
    draws = np.linalg.solve(np.linalg.cholesky(precision).T, rng.normal(size=(design.shape[1], 64)))
    _, shown = arm.parameters.linearised(arm.change, test)
    return float(np.linalg.norm((shown[:, :, free] * std[free]) @ draws, axis=1).mean())
