"""List the hypotheses to test: every effect at every place where it can act, as far as the data can test it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import EFFECT_TYPES, Effect, EffectType, Simulation


class HypothesisSettings:
    # A joint that moves less than this cannot be tested [rad, m].
    still = 1e-4
    min_rows = 20


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The effects to test, and the reasons why others are left out."""

    effects: tuple[Effect, ...]  # one of each kind and place, with zero amounts
    limitations: tuple[str, ...]  # reasons why some were left out, a sentence each

    @classmethod
    def of(
        cls,
        simulation: Simulation,
        observations: Observations,
        *,
        only: Collection[str] = (),
        without: Collection[str] = (),
    ) -> Hypotheses:
        """List all requested effects that this recording of this robot can test."""
        limits = _Limits(simulation, observations)
        robot = simulation.robot
        wanted = [name for name in EFFECT_TYPES if (not only or name in only) and name not in without]
        effects = []
        for kind in map(EFFECT_TYPES.__getitem__, wanted):
            if limits.excludes(kind):
                continue
            if not kind.at_joint:
                effects.append(Effect.at(robot, kind.name))
                continue
            for k, joint in enumerate(robot.joints):
                if (kind.turns_only and robot.chain.prismatic[k]) or limits.still[k]:
                    continue
                sources = [s for j, s in enumerate(robot.joints) if s != joint and not limits.still[j]]
                effects += [Effect.at(robot, kind.name, joint, s) for s in (sources if kind.takes_source else [None])]
        return cls(tuple(effects), tuple(limits.sentences))


def has_simpler_name(effect: Effect, hypotheses: Collection[Effect], simulation: Simulation) -> bool:
    """Return True for the link before the first joint if the camera's pose is a hypothesis.

    In any motion they are the same. The pose, which is measured by hand, is named, and the link is reported as its
    rival.
    """
    if not effect.kind.in_parts or simulation.place(effect).joint != 0 or simulation.upward[0]:
        return False
    return any(one.kind.stage == "camera" and one.kind.rigid for one in hypotheses)


class _Limits:
    """Effects that this recording cannot test."""

    def __init__(self, simulation: Simulation, observations: Observations) -> None:
        self._simulation, self._motion = simulation, observations.motion
        robot = simulation.robot
        self.still = np.ptp(observations.motion.q, axis=0) < HypothesisSettings.still
        self.sentences: list[str] = []
        standing = [joint for joint, still in zip(robot.joints, self.still, strict=True) if still]
        if standing:
            self.sentences.append(
                f"{', '.join(standing)} never moved: nothing can be said of {'it' if len(standing) == 1 else 'them'}."
            )
        if observations.motion.t is None:
            self.sentences.append("The recording has no times: late images and drift cannot be tested.")
        if robot.calibration is None:
            self.sentences.append(
                "robot.toml has no stereo calibration: a wrong focal length and lens distortion cannot be tested."
            )
        if robot.robot.hold == "torque_free":
            self.sentences.append(
                'robot.toml says hold = "torque_free": the hand bore the weight, so sag was not tested. If the arm '
                'held itself, write hold = "held" and diagnose again.'
            )
        elif not simulation.gravity.known:
            self.sentences.append(
                "The URDF states no masses: links of 1 kg per metre were assumed, so how far joints give under the "
                "arm's weight is rough, and what resembles it at the same joint may be a part of it."
            )

    def excludes(self, kind: EffectType) -> bool:
        """Return True if no effect of this kind can be tested, or if it consists of free parameters."""
        robot = self._simulation.robot
        if kind.needs_weight:
            unknown = kind.is_load and not self._simulation.gravity.known
            return unknown or robot.robot.hold == "torque_free"
        if kind.rigid and not kind.at_joint:
            return kind.is_free(robot)
        if kind.needs_times and self._motion.t is None:
            return True
        if kind.needs_stereo and robot.calibration is None:
            return True
        return len(self._motion) < HypothesisSettings.min_rows
