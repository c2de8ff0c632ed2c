"""Small recordings of the desk arm with known hidden effects."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping

import numpy as np
from walked import DESK_ARM

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.fit import Fit
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Effect, Motion, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

SIGMA_M = 3e-4
INTERVAL_S = 0.25
BASE, SHOULDER, ELBOW, WRIST = "base_yaw", "shoulder_pitch", "elbow_pitch", "wrist_roll"


def desk_arm(changes: Mapping[str, str] | None = None) -> RobotDescription:
    """Return the desk arm with lines of its robot.toml changed."""
    text = DESK_ARM.read_text()
    for old, new in (changes or {}).items():
        assert old in text
        text = text.replace(old, new)
    return RobotDescription.from_tables(tomllib.loads(text), text, DESK_ARM)


def surveyed_arm() -> RobotDescription:
    """Return the desk arm with known camera and marker."""
    return desk_arm({"_known = false": "_known = true"})


def motion_of(q: FloatArray) -> Motion:
    """Return readings (n, d) in one run, at four per second."""
    return Motion(q, INTERVAL_S * np.arange(len(q)), np.zeros(len(q), np.int64))


def walk(robot: RobotDescription, seed: int, rows: int = 300) -> Motion:
    """Return a walk over most of the joints' range."""
    rng = np.random.default_rng(seed)
    steps = np.cumsum(rng.normal(size=(rows, len(robot.joints))), axis=0)
    shares = (steps - steps.min(axis=0)) / np.ptp(steps, axis=0)
    return motion_of(robot.lower + (0.1 + 0.8 * shares) * (robot.upper - robot.lower))


def scattered(robot: RobotDescription, seed: int, rows: int = 300) -> Motion:
    """Return unrelated poses over most of the joints' range."""
    shares = np.random.default_rng([seed, 2]).uniform(0.1, 0.9, size=(rows, len(robot.joints)))
    return motion_of(robot.lower + shares * (robot.upper - robot.lower))


def seen(robot: RobotDescription, motion: Motion, effects: tuple[Effect, ...], seed: int) -> Recording:
    """Return a recording of an arm with `effects`, with isotropic noise whose stated covariance is correct."""
    n = len(motion)
    noise = SIGMA_M * np.random.default_rng([seed, 1]).normal(size=(n, 3))
    return measured(robot, motion, Simulation(robot, effects).positions(motion) + noise)


def measured(robot: RobotDescription, motion: Motion, x: FloatArray) -> Recording:
    """Return a recording of positions x (n, 3) [m], their noise stated as `SIGMA_M`."""
    cov = np.broadcast_to(SIGMA_M**2 * np.eye(3), (len(motion), 3, 3))
    return Recording(joints=robot.joints, q=motion.q, x=x, t=motion.t, cov=cov, segment=motion.segment)


def observed(robot: RobotDescription, motion: Motion, effects: tuple[Effect, ...], seed: int) -> Observations:
    """Return `seen` as observations of the diagnosis."""
    return Observations.of(seen(robot, motion, effects, seed), Simulation(robot))


def start_of(robot: RobotDescription, motion: Motion, effects: tuple[Effect, ...], seed: int) -> Fit:
    """Return the fit without any cause."""
    return aligned(observed(robot, motion, effects, seed), Simulation(robot))


def at_rest(effect: Effect) -> Effect:
    """Return the effect with amounts of zero; moments and periods stay."""
    values = effect.values.copy()
    values[effect.amounts] = 0.0
    return effect.with_values(values)
