"""Nominal model, from which learning starts."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from bodyschema.effects import Motion, Simulation
from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.learning.changes.known_arm import ArmSettings
from bodyschema.learning.config import LearnerConfig
from bodyschema.learning.solvers.orientation import BatchSettings
from bodyschema.robot.description import RobotDescription
from kbmaps import (
    ChainBelief,
    ChainParameters,
    ChainTolerances,
    JointBasis,
    KBMap,
    RigidChain,
    align,
    learning_bases,
    with_refitted_tool,
)
from kbmaps.arrays import evenly_spread


class NominalSettings:
    # Number of pairs after a tool change at which the tool is first fitted; later fits follow at doubled numbers.
    pairs_to_refit = 5
    narrowest_stroke_m = 0.1  # a narrower stroke would make the basis needlessly stiff, and equal limits impossible
    largest_grid = 20_000  # maximum number of postures at which an extended simulation is evaluated for a prior


@dataclass(frozen=True)
class NominalModel:
    """Chain of robot.toml and URDF, with a description of its roughly known parts."""

    chain: RigidChain  # measurement frame to marker
    # lower, upper: joint limits, shape (d,) [rad or m]
    lower: FloatArray
    upper: FloatArray
    # pose_known, marker_known: as in robot.toml
    pose_known: bool = True
    marker_known: bool = True
    extended: Simulation | None = None  # the simulation whose rigid part the chain is, if it has other effects too
    # bases of the learnt maps: scaled orthonormal over the whole turn, or the stroke of a prismatic joint
    bases: tuple[JointBasis, ...] = field(init=False)

    def __post_init__(self) -> None:
        slides = self.chain.prismatic
        low, high = np.where(slides, self.lower, -np.pi), np.where(slides, self.upper, np.pi)
        widening = np.maximum(NominalSettings.narrowest_stroke_m - (high - low), 0.0) / 2.0
        object.__setattr__(self, "lower", frozen_array(self.lower))
        object.__setattr__(self, "upper", frozen_array(self.upper))
        object.__setattr__(
            self, "bases", learning_bases(low - widening, high + widening, self.chain.prismatic.tolist())
        )

    @classmethod
    def of(cls, robot: RobotDescription) -> NominalModel:
        return cls(robot.chain, robot.lower, robot.upper, robot.camera.pose_known, robot.robot.marker_known)

    @classmethod
    def extended_by(cls, simulation: Simulation) -> NominalModel:
        """Return the nominal model of a robot with effects, in its state with all of them present.

        The rigid part of the effects is in the chain. The rest is in the prior, as far as a map can hold it: over the
        joints' ranges, and only if the measurement frame is known.
        """
        since = simulation.since.placed
        robot = since.robot
        known = robot.camera.pose_known, robot.robot.marker_known
        has_deviations = len(since.all_effects) > len(since.rigid.all_effects) or since.residual is not None
        return cls(
            since.rigid_chain, robot.lower, robot.upper, *known, since if has_deviations and all(known) else None
        )

    @property
    def joints(self) -> int:
        return self.chain.joints

    @property
    def size(self) -> int:
        """Number of control points of a map: 3^d if all joints are revolute."""
        return math.prod(basis.size for basis in self.bases)

    @property
    def frame_known(self) -> bool:
        """True if predictions are meaningful before any pair."""
        return self.pose_known and self.marker_known

    @property
    def pairs_to_align(self) -> int:
        """Number of pairs before an unknown frame or marker is fitted: twice the minimum, and some spread."""
        return 0 if self.frame_known else 5 if self.pose_known else 10

    @property
    def unknown(self) -> str:
        """Settings of robot.toml that declare a part unknown, as written there."""
        flags = (("[camera] pose_known", self.pose_known), ("[robot] marker_known", self.marker_known))
        return " and ".join(f"{name} = false" for name, known in flags if not known)

    def reach(self, angle: float) -> FloatArray:
        """Return `angle` [rad] for a revolute joint, the same fraction of its stroke [m] for a prismatic one (d,)."""
        return np.where(self.chain.prismatic, angle * (self.upper - self.lower) / np.pi, angle)

    def fingerprint(self, tolerances: ChainTolerances) -> str:
        """Return a hash of this nominal model with these tolerances; a state only fits the ones it was made with."""
        identity = f"{self.pose_known} {self.marker_known} {tolerances} {self.prior.digest}"
        return hashlib.blake2b(identity.encode(), digest_size=8).hexdigest()

    @cached_property
    def prior(self) -> KBMap:
        """Chain as a map in the learning bases, with the deflections of the extended simulation."""
        prior = self.chain.to_kbmap(self.bases)
        if self.extended is None or (nodes := self._nodes()) is None:
            return prior
        q = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, self.joints)
        deviations = self.extended.positions(Motion.still(q)) - self.chain.positions(q)
        net = deviations.T.reshape(3, *map(len, nodes))
        for k, basis in enumerate(self.bases):
            solve = np.linalg.pinv(basis.weights(nodes[k]))
            net = np.moveaxis(np.tensordot(solve, net, axes=(1, k + 1)), 0, k + 1)
        # A map that also has the marker's axes keeps them as in the chain.
        net = np.concatenate([prior.net[:3] + net, prior.net[3:]])
        return KBMap(self.bases, net, prior.metadata)

    def _nodes(self) -> list[FloatArray] | None:
        """Return the grid values of each joint over its range that determine a map; None for too large a grid."""
        count = next((n for n in (5, 4, 3) if n**self.joints <= NominalSettings.largest_grid), None)
        if count is None:
            return None
        low = np.where(self.chain.prismatic, self.lower, np.maximum(self.lower, -np.pi))
        high = np.where(self.chain.prismatic, self.upper, np.minimum(self.upper, np.pi))
        shares = 0.5 * (1.0 + np.polynomial.legendre.leggauss(count)[0])
        return [a + (b - a) * shares for a, b in zip(low, high, strict=True)]

    def belief(self, chain: RigidChain, tolerances: ChainTolerances) -> ChainBelief:
        """Return the prior of the real chain before any pair.

        Args:
            chain: the nominal chain, placed if its pose is unknown.
            tolerances: of a chain whose frame and marker are known.
        """
        return ChainBelief.from_tolerances(ChainParameters(chain), self.tolerances(tolerances))

    def tolerances(self, known: ChainTolerances) -> ChainTolerances:
        """Return the tolerances of the nominal chain, given those of one whose frame and marker are known."""
        if not self.pose_known:
            known = replace(known, base_rotation=math.inf, base_translation=math.inf)
        if not self.marker_known:
            # A marker is on the hand. First pairs along a short path would fit a marker one metre away equally well.
            known = replace(known, tool=ArmSettings.other_tool_m)
        return known

    def aligned_chain(self, q: FloatArray, x: FloatArray) -> RigidChain:
        """Return the chain with an unknown pose fitted to pairs, q (n, d) [rad] and x (n, 3) [m].

        Its marker is at its nominal position.

        Raises:
            DegenerateDataError: the pairs do not determine it.
        """
        chosen = evenly_spread(len(q), BatchSettings.fitted)
        return align(self.chain, q[chosen], x[chosen], pose_known=self.pose_known, marker_known=True).chain

    def with_other_tool(self, kbmap: KBMap, chain: RigidChain, q: FloatArray, x: FloatArray) -> KBMap:
        """Return a learnt map with its marker moved to fit pairs since the tool change, q (n, d) and x (n, 3).

        Args:
            kbmap: the learnt map.
            chain: the nominal chain in the frame that the map was learnt in; it gives the hand's orientation.

        Raises:
            DegenerateDataError: there are no pairs.
        """
        chosen = evenly_spread(len(q), BatchSettings.fitted)
        return with_refitted_tool(kbmap, chain, q[chosen], x[chosen])


def chain_tolerances(settings: LearnerConfig) -> ChainTolerances:
    """Return the tolerances of a real chain, its frame and its marker about their nominal values."""
    angle, place = math.radians(settings.angle_tolerance_deg), settings.place_tolerance_m
    return ChainTolerances(
        axes=angle,
        points=settings.length_tolerance_m,
        zeros=angle,
        slide_zeros=settings.length_tolerance_m,
        tool=place,
        base_rotation=angle,
        base_translation=place,
    )
