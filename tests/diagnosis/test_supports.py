"""A mount's compliance is not mistaken for a joint's, nor the other way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from planted_cases import DESK_ARM, ELBOW, SHOULDER, SIGMA_M, desk_arm, measured, seen, walk
from scipy.spatial.transform import Rotation

from bodyschema.diagnosis.diagnosis import diagnose
from bodyschema.diagnosis.report.conclusion import conclusion
from bodyschema.diagnosis.report.result import DiagnosisFile
from bodyschema.effects import Effect, Simulation
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription

MASSES = {"turret": 0.6, "upper_arm": 0.5, "forearm": 0.35, "wrist": 0.15, "gripper": 0.1}


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> RobotDescription:
    """Return the desk arm, held by its motors, with masses half way along its links and known camera and marker."""
    folder: Path = tmp_path_factory.mktemp("heavy")
    urdf = DESK_ARM.with_name("desk_arm.urdf").read_text()
    for link, kg in MASSES.items():
        mass = f'<inertial><origin xyz="0.01 0 0.1"/><mass value="{kg}"/></inertial>'
        urdf = urdf.replace(f'<link name="{link}"/>', f'<link name="{link}">{mass}</link>')
    (folder / "desk_arm.urdf").write_text(urdf)
    text = DESK_ARM.read_text().replace("torque_free", "held").replace("_known = false", "_known = true")
    (folder / "robot.toml").write_text(text)
    return RobotDescription.load(folder / "robot.toml")


def moments_about_the_floor(robot: RobotDescription, q: np.ndarray) -> np.ndarray:
    """Return the weight's moments (n, 3) [N·m]: the change of height of its centre as the floor is tilted."""
    moments, forces = Simulation(robot).gravity.loads(q)
    (T, *_) = Simulation(robot).gravity.in_support_frames(0)
    return moments[:, 0] @ T[:3, :3].T + np.cross(T[:3, 3], forces[:, 0] @ T[:3, :3].T)


def on_a_soft_mount(robot: RobotDescription, times_the_noise: float, seed: int) -> Recording:
    """Return the positions on a mount that turns about the floor's origin, in proportion to the moment on it."""
    motion, camera = walk(robot, seed), robot.camera.pose
    x = Simulation(robot).positions(motion)
    floor = x @ camera[:3, :3].T + camera[:3, 3]
    turned = 1e-5 * moments_about_the_floor(robot, motion.q)
    moved = (Rotation.from_rotvec(turned).apply(floor) - camera[:3, 3]) @ camera[:3, :3] - x
    moved *= times_the_noise * SIGMA_M / np.sqrt(np.square(moved).mean())
    return measured(robot, motion, x + moved + SIGMA_M * np.random.default_rng([seed, 1]).normal(size=x.shape))


def found(recording: Recording, robot: RobotDescription, only: tuple[str, ...] = ()) -> DiagnosisFile:
    return conclusion(diagnose(recording, Simulation(robot), only=only))


def with_a_link_that_bends(robot: RobotDescription, times_the_noise: float, seed: int) -> Recording:
    """Return the positions with an upper arm that bends across its middle, in proportion to the moment there."""
    motion, k = walk(robot, seed), robot.joints.index(ELBOW)
    run, (T, *_) = Simulation(robot).run(motion), Simulation(robot).gravity.in_support_frames(robot.joints.index(ELBOW))
    moments, forces = (load[:, k] for load in Simulation(robot).gravity.loads(motion.q))
    half = 0.5 * T[:3, 3] @ T[:3, :3]
    along = half / np.linalg.norm(half)
    bending = moments + np.cross(half, forces)
    bending -= np.outer(bending @ along, along)
    R, elbow = run.frames[:, k, :3, :3], run.frames[:, k, :3, 3]
    lever = run.measured - elbow + R @ half
    moved = np.cross(np.einsum("nij,nj->ni", R, bending), lever)
    moved *= times_the_noise * SIGMA_M / np.sqrt(np.square(moved).mean())
    noise = SIGMA_M * np.random.default_rng([seed, 1]).normal(size=moved.shape)
    return measured(robot, motion, run.measured + moved + noise)


@pytest.mark.soak
def test_bending_link_is_unexplained_without_named_cause(robot) -> None:
    file = found(with_a_link_that_bends(robot, 0.5, 1), robot)
    assert (file.verdict, file.causes) == ("unexplained", ())
    assert file.unexplained.what == (f"what carries {ELBOW} gives under the arm's weight",)


@pytest.mark.parametrize("size", [1.0, 4.0])
@pytest.mark.soak
def test_isotropically_soft_mount_is_unexplained_without_named_cause(robot, size) -> None:
    file = found(on_a_soft_mount(robot, size, 1), robot)
    assert (file.verdict, file.causes) == ("unexplained", ())
    assert file.unexplained.what[0].endswith("gives under the arm's weight")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.soak
def test_a_small_one_is_no_sure_cause(robot, seed) -> None:
    file = found(on_a_soft_mount(robot, 0.3, seed), robot)
    assert all(cause.probability < 0.9 for cause in file.causes)


@pytest.mark.soak
@pytest.mark.parametrize("where", [SHOULDER, ELBOW])
def test_a_joint_that_gives_is_named(robot, where) -> None:
    truth = Effect.at(robot, "joint_compliance", where, values=[0.03])
    (cause,) = found(seen(robot, walk(robot, 1), (truth,), 1), robot).causes
    assert (cause.effect, cause.where) == ("joint_compliance", where)


# Among all effects it takes four times as long.
NEAREST = ("joint_compliance", "joint_eccentricity", "joint_scale", "backlash")


def made_to_a_tenth_of_a_millimetre(robot: RobotDescription, cause: Effect, seed: int) -> Recording:
    rng, motion = np.random.default_rng([seed, 1]), walk(robot, seed)
    off = [np.array([1e-4] * 3 + [3e-4] * 3) * rng.normal(size=6) for _ in robot.joints]
    links = (Effect.at(robot, "link_geometry", *one) for one in zip(robot.joints, [None] * len(off), off, strict=True))
    x = Simulation(robot, (cause,), None, tuple(links)).positions(motion)
    return measured(robot, motion, x + SIGMA_M * rng.normal(size=x.shape))


@pytest.mark.parametrize("seed", range(1, 4))
@pytest.mark.parametrize("only", [NEAREST, pytest.param((), marks=pytest.mark.soak)], ids=["nearest", "all"])
def test_joint_compliance_is_named_without_urdf_masses(robot, only, seed) -> None:
    # Where nothing else is off, a function of both joints explains what other masses change as well.
    truth = Effect.at(robot, "joint_compliance", SHOULDER, values=[0.03])
    recording = made_to_a_tenth_of_a_millimetre(robot, truth, seed)
    held = {"torque_free": "held", "_known = false": "_known = true"}
    file = found(recording, desk_arm(held), only)
    first = max(file.causes, key=lambda cause: cause.weight_percent)
    assert (first.effect, first.where) == ("joint_compliance", SHOULDER)
    assert "N·m" not in file.sentence
    assert not file.weighed
    there = [cause for cause in file.causes if cause.where == SHOULDER]
    beside = [cause.probability for cause in there if cause.effect in ("joint_eccentricity", "joint_scale")]
    assert all(probability <= 0.5 for probability in beside)


@pytest.mark.soak
def test_possible_soft_mount_is_reported_with_a_check(robot) -> None:
    truth = Effect.at(robot, "joint_compliance", SHOULDER, values=[4e-4])
    file = found(seen(robot, walk(robot, 1), (truth,), 1), robot)
    (cause,) = file.causes
    (rival,) = [rival for rival in cause.rivals if rival.effect == "unexplained"]
    assert rival.what.endswith("gives under the arm's weight")
    assert any(line.startswith(f"Watch whether {rival.what}") for line in file.advice)


def test_supporting_frames_span_link_up_to_previous_joint(robot) -> None:
    poses = Simulation(robot).gravity.in_support_frames(robot.joints.index(SHOULDER))
    assert len(poses) == 1
    np.testing.assert_allclose(poses[0][:3, 3], [0.03, 0.0, 0.06])
