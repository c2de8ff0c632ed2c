"""Arms that are not quite rigid: `python -m benchmarks.rough_truths [--seeds N] [--truth NAME ...] [--pairs N ...]`.

With `--recording FOLDER` (one with a robot.toml): the mean error on the held-out rows of a measured arm, over random
splits with `--pairs` training rows.

Six joints of a humanoid arm, nominal model wrong by 2 degrees an axis, 10 mm a point and 30 mm at the marker (each
component), pairs uniform within +-60 degrees, 5 mm of noise on each coordinate. Errors are mean distances to the
noise-free truth within +-60 and within +-80 degrees [mm], followed by the percentage of coordinates within 1 and 2
sigma. All are means over the seeds. The learners are given the noise only with `--told`.

The truths are built from physical effects and not from the assumptions of a learner:

    rigid       the rigid true arm
    affine      the camera stretches each axis by 2 to 3 % and shears by 1 %
    eccentric   each encoder reads 1 degree * sin off, at its own phase
    gain        each gear is off by 1 %
    sag1, sag3  links with masses beside their axes; gravity's torque deflects each joint by up to 1 or 3 degrees within
                +-60, at equilibrium
    head        as sag1, but the camera is on the head: gravity is constant behind the two joints of the neck
    bearings    as sag1, and each joint also deflects by a third as much across its axis
    lens        radial distortion, 2 % at the edge, and 1 % of depth
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.humanoid_arm import NECK_JOINTS
from benchmarks.recording import RECORDED, Recording
from benchmarks.rough_arm import RoughArm, rough_arm
from benchmarks.side_by_side import SideBySide
from kbmaps import ChainTolerances, Model, ResidualLearner, RigidLearner, TensorLearner, TensorSettings, learning_bases
from kbmaps.arrays import FloatArray

ROUGH = ChainTolerances(axes=np.radians(2.0), points=0.01, tool=0.03)
SIGMA = 0.005
JOINTS = 6
REACH_DEG, WIDE_DEG = 60.0, 80.0
TEST_ROWS = 500
Truth = Callable[[FloatArray], FloatArray]
# Times the yielding is applied to the torque that it brings about itself.
_EQUILIBRIUM_ROUNDS = 4


class SaggingArm:
    """A chain of links with masses, whose joints are springs.

    Args:
        largest: greatest deflection about each joint's axis for configurations within the reach [rad].
        across: ratio of the deflections across and about the axis, for the same torque.
        still: number of joints before the stationary link, in whose frame gravity is constant.
    """

    def __init__(
        self, arm: RoughArm, rng: np.random.Generator, largest: float, across: float = 0.0, still: int = 0
    ) -> None:
        self._chain = arm.parameters.chain(arm.change)
        self._across, self._still = across, still
        self._masses = rng.uniform(0.5, 2.0, JOINTS)
        # Somewhere along the link, and beside it.
        self._shares = rng.uniform(0.3, 0.7, JOINTS)
        self._beside = rng.normal(0.0, 0.02, (JOINTS, 3))
        self._down = rng.normal(size=3)
        self._down /= np.linalg.norm(self._down)
        self._compliance = np.ones(JOINTS)
        sample = arm.angles(2000, REACH_DEG, rng)
        frames = self._frames(sample, np.zeros((len(sample), JOINTS, 3)))
        torques = np.einsum("nki,nki->nk", self._torques(frames), self._axes(frames))
        self._compliance = largest / np.maximum(np.abs(torques).max(axis=0), 1e-9)

    def positions(self, q: FloatArray) -> FloatArray:
        yielded = np.zeros((len(q), JOINTS, 3))
        frames = self._frames(q, yielded)
        for _ in range(_EQUILIBRIUM_ROUNDS):
            torques, axes = self._torques(frames), self._axes(frames)
            about = np.einsum("nki,nki->nk", torques, axes)[..., None] * axes
            turn = self._compliance[:, None] * (about + self._across * (torques - about))
            # A rotation vector in the frame of the joint before it moves.
            yielded = np.einsum("nkji,nkj->nki", frames[:, :-1, :3, :3], turn)
            frames = self._frames(q, yielded)
        return frames[:, -1, :3, 3]

    def _frames(self, q: FloatArray, yielded: FloatArray) -> FloatArray:
        """Return frames of joints and marker (n, d+1, 4, 4) with each joint turned by a further rotation vector."""
        pose = np.broadcast_to(self._chain.fixed[0], (len(q), 4, 4))
        frames = [pose]
        for k in range(JOINTS):
            motion = np.zeros((len(q), 4, 4))
            turns = Rotation.from_rotvec(q[:, k, None] * self._chain.axes[k])
            motion[:, :3, :3] = (Rotation.from_rotvec(yielded[:, k]) * turns).as_matrix()
            motion[:, 3, 3] = 1.0
            pose = pose @ motion @ self._chain.fixed[k + 1]
            frames.append(pose)
        return np.stack(frames, axis=1)

    def _axes(self, frames: FloatArray) -> FloatArray:
        return np.einsum("nkij,kj->nki", frames[:, :-1, :3, :3], self._chain.axes)

    def _torques(self, frames: FloatArray) -> FloatArray:
        """Return torque vectors (n, d, 3) of all links beyond each joint, about its origin."""
        origins, ends = frames[:, :-1, :3, 3], frames[:, 1:, :3, 3]
        beside = np.einsum("nkij,kj->nki", frames[:, 1:, :3, :3], self._beside)
        centres = origins + self._shares[:, None] * (ends - origins) + beside
        force = (frames[:, self._still, :3, :3] if self._still else np.eye(3)) @ self._down
        total = np.zeros_like(origins)
        for joint in range(self._still, JOINTS):
            for link in range(joint, JOINTS):
                lever = centres[:, link] - origins[:, joint]
                total[:, joint] += self._masses[link] * np.cross(lever, force)
        return total


def affine(arm: RoughArm, rng: np.random.Generator) -> Truth:
    stretch = np.diag(1.0 + rng.uniform(0.02, 0.03, 3) * rng.choice([-1.0, 1.0], 3))
    shear = np.triu(0.01 * rng.normal(size=(3, 3)), 1)
    return lambda q: arm.positions(q) @ (stretch + shear).T


def eccentric(arm: RoughArm, rng: np.random.Generator) -> Truth:
    phase = rng.uniform(-np.pi, np.pi, JOINTS)
    return lambda q: arm.positions(q + np.radians(1.0) * np.sin(q + phase))


def gain(arm: RoughArm, rng: np.random.Generator) -> Truth:
    factor = 1.0 + 0.01 * rng.choice([-1.0, 1.0], JOINTS)
    return lambda q: arm.positions(q * factor)


def lens(arm: RoughArm, rng: np.random.Generator) -> Truth:
    seen = arm.positions(arm.angles(2000, REACH_DEG, rng))
    centre = seen.mean(axis=0)
    edge = float(np.quantile(np.linalg.norm((seen - centre)[:, 1:], axis=1), 0.99))

    def distorted(q: FloatArray) -> FloatArray:
        x = arm.positions(q) - centre
        square = np.square(x[:, 1:]).sum(axis=1, keepdims=True) / edge**2
        return centre + np.concatenate([1.01 * x[:, :1], x[:, 1:] * (1.0 + 0.02 * square)], axis=1)

    return distorted


TRUTHS: dict[str, Callable[[RoughArm, np.random.Generator], Truth]] = {
    "rigid": lambda arm, _: arm.positions,
    "affine": affine,
    "eccentric": eccentric,
    "gain": gain,
    "sag1": lambda arm, rng: SaggingArm(arm, rng, np.radians(1.0)).positions,
    "sag3": lambda arm, rng: SaggingArm(arm, rng, np.radians(3.0)).positions,
    "head": lambda arm, rng: SaggingArm(arm, rng, np.radians(1.0), still=NECK_JOINTS).positions,
    "bearings": lambda arm, rng: SaggingArm(arm, rng, np.radians(1.0), across=1.0 / 3.0).positions,
    "lens": lens,
}


def rigid(arm: RoughArm, _: int) -> Model:
    return RigidLearner(arm.drawing, ROUGH)


def train(arm: RoughArm, pairs: int) -> Model:
    reach = np.full(JOINTS, np.radians(REACH_DEG))
    settings = TensorSettings(refit_every=pairs)
    return TensorLearner.around(
        arm.drawing,
        learning_bases(-reach, reach),
        settings,
        turn_std=ROUGH.axes,
        shift_std=ROUGH.points,
        marker_std=ROUGH.tool,
    )


def residual(arm: RoughArm, _: int) -> Model:
    return ResidualLearner(arm.drawing, ROUGH)


def ladder(arm: RoughArm, _: int) -> SideBySide:
    reach = np.full(JOINTS, np.radians(REACH_DEG))
    return SideBySide(arm.drawing, ROUGH, -reach, reach)


MODELS: dict[str, Callable[[RoughArm, int], Model | SideBySide]] = {
    "rigid": rigid,
    "train": train,
    "residual": residual,
    "ladder": ladder,
}


def run(truth: str, model: str, pairs: int, seed: int, told: bool) -> list[float]:
    """Return the mean error and coverage within 1 and 2 sigma, near and wide, and the CPU time [s]."""
    rng = np.random.default_rng(seed)
    arm = rough_arm(JOINTS, rng, ROUGH)
    positions = TRUTHS[truth](arm, rng)
    q = arm.angles(pairs, REACH_DEG, rng)
    x = positions(q) + SIGMA * rng.normal(size=(pairs, 3))
    tests = [arm.angles(TEST_ROWS, reach, rng) for reach in (REACH_DEG, WIDE_DEG)]
    learner = MODELS[model](arm, pairs)
    begin = time.process_time()
    learner.learn(q, x, SIGMA if told else None)
    learner.predict(tests[0])
    taken = time.process_time() - begin
    figures: list[float] = []
    for test in tests:
        estimate = learner.estimate(test)
        off = estimate.x - positions(test)
        ratios = np.abs(off) / estimate.sigma
        figures.append(1e3 * float(np.linalg.norm(off, axis=1).mean()))
        figures += [100.0 * float((ratios < k).mean()) for k in (1.0, 2.0)]
    return [*figures, taken]


def recording_split(known: Recording, pairs: int, seed: int) -> tuple[float, float]:
    """Return mean held-out errors [mm] for a random split: of the rigid chain, and with the residual."""
    learnt, rest = known.split(pairs, seed)
    learner = ResidualLearner(known.chain, RECORDED)
    learner.learn(known.q[learnt], known.x[learnt])
    alone, whole = (
        1e3 * float(np.linalg.norm(model.predict(known.q[rest]) - known.x[rest], axis=1).mean())
        for model in (learner.rigid, learner)
    )
    return alone, whole


def recording(folder: Path, pairs: int, seeds: range) -> None:
    known = Recording.load(folder)
    alone, whole = np.mean([recording_split(known, pairs, seed) for seed in seeds], axis=0)
    print(f"{folder.name}: {pairs:5d} pairs  rigid {alone:.4f}  residual {whole:.4f} mm", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--truth", nargs="+", choices=tuple(TRUTHS), default=list(TRUTHS))
    parser.add_argument("--pairs", nargs="+", type=int, default=[100, 300, 1000, 3000])
    parser.add_argument("--model", nargs="+", choices=tuple(MODELS), default=list(MODELS))
    parser.add_argument("--told", action="store_true", help="tell the learners the noise")
    parser.add_argument("--recording", type=Path, action="append", default=[], help="folder with a robot.toml")
    arguments = parser.parse_args()
    for folder in arguments.recording:
        for pairs in arguments.pairs:
            recording(folder, pairs, range(arguments.first_seed, arguments.first_seed + arguments.seeds))
    for truth in () if arguments.recording else arguments.truth:
        print(f"\n{truth}: pairs, model, error within +-60 (1, 2 sigma), within +-80 deg (1, 2 sigma), fit [s]")
        for pairs in arguments.pairs:
            for model in arguments.model:
                seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
                rows = [run(truth, model, pairs, seed, arguments.told) for seed in seeds]
                near, near1, near2, wide, wide1, wide2, taken = np.mean(rows, axis=0)
                print(
                    f"  {pairs:5d}  {model:8s}  {near:6.2f} ({near1:3.0f} {near2:3.0f})"
                    f"  {wide:6.2f} ({wide1:3.0f} {wide2:3.0f})  {taken:6.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
