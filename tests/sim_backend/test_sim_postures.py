from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet")

from guided_run import NoRenderer, shipped

from bodyschema.interfaces.errors import SourceEnded
from bodyschema.interfaces.records import FloatArray, StereoFrame
from bodyschema.sim_backend import SimConfig, true_chain
from bodyschema.sim_backend.posed import PosedWorld, visible_postures

LIMIT_S = 500.0
POSTURES = 3


@pytest.fixture(scope="module")
def postures() -> FloatArray:
    return visible_postures(shipped(), SimConfig(), POSTURES)


@pytest.fixture
def unrendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Open worlds without a renderer."""
    monkeypatch.setattr("bodyschema.sim_backend.posed.RenderProcess", NoRenderer)


def seen(world: PosedWorld) -> list[StereoFrame]:
    frames = []
    with world.joints, world.camera:
        for _ in range(POSTURES):
            frame = world.camera.read(LIMIT_S)
            assert frame is not None
            frames.append(frame)
    return frames


def test_postures_lie_within_the_joint_limits(postures: FloatArray) -> None:
    robot = shipped()
    assert ((postures >= robot.lower) & (postures <= robot.upper)).all()


def test_other_seeds_give_other_postures(postures: FloatArray) -> None:
    assert not np.allclose(visible_postures(shipped(), SimConfig(seed=3), POSTURES), postures)


def test_encoders_report_each_posture_to_the_tick(postures: FloatArray, unrendered) -> None:
    config = SimConfig()
    tick = 2 * np.pi / config.encoders.ticks_per_turn
    with PosedWorld(shipped(), config, postures) as world, world.joints as joints:
        readings = np.array([joints.read(LIMIT_S).q for _ in range(POSTURES)])
    assert np.abs(readings - postures).max() < 3 * tick


def test_posture_reading_and_frame_share_a_time(postures: FloatArray, unrendered) -> None:
    with PosedWorld(shipped(), SimConfig(), postures) as world:
        frames = seen(world)
        with world.joints as joints:
            assert [joints.read(LIMIT_S).t for _ in range(POSTURES)] == [frame.t for frame in frames]


def test_the_sources_end_after_the_last_posture(postures: FloatArray, unrendered) -> None:
    with PosedWorld(shipped(), SimConfig(), postures) as world:
        seen(world)
        with world.camera as camera, pytest.raises(SourceEnded):
            camera.read(LIMIT_S)


@pytest.mark.soak
def test_same_postures_give_bitwise_identical_frames(postures: FloatArray) -> None:
    taken = []
    for _ in range(2):
        with PosedWorld(shipped(), SimConfig(), postures) as world:
            taken.append([image for frame in seen(world) for image in (frame.left, frame.right)])
    np.testing.assert_array_equal(*taken)


def test_posed_robot_equals_the_guided_robot(postures: FloatArray, unrendered) -> None:
    with PosedWorld(shipped(), SimConfig(), postures) as world:
        np.testing.assert_array_equal(
            world.true_chain().positions(postures), true_chain(shipped(), SimConfig()).positions(postures)
        )
