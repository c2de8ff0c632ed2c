"""Each effect changes readings and positions according to its mechanism."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pybullet")

from .arms import BASE, FLOOR, MOUNT, Arm, Joint, Mass, industrial
from .arrays import FloatArray
from .bullet import GRAVITY, Bullet, bullet
from .eyes import in_view
from .hidden import Hidden
from .joints import left_of_move
from .motion import Motion, Style, move
from .world import Sight, World

SHIFT = (0.003, -0.002, 0.004)
NO_TURN = {"rx_rad": 0.0, "ry_rad": 0.0, "rz_rad": 0.0}


def shifted(**more: float) -> dict[str, float]:
    """Return the parameters of a shift."""
    return {**dict(zip(("dx_m", "dy_m", "dz_m"), SHIFT, strict=True)), **more}


def six(turn: tuple[float, float, float], **more: float) -> dict[str, float]:
    """Return the parameters of a shift and a turn."""
    return {**shifted(), **dict(zip(NO_TURN, turn, strict=True)), **more}


@pytest.fixture(scope="module")
def client() -> Iterator[Bullet]:
    with bullet() as opened:
        yield opened


@pytest.fixture(scope="module")
def arm() -> Arm:
    return industrial(np.random.default_rng(8))


class Bench:
    """Forty postures of one arm in front of its cameras, under one hidden effect or none."""

    def __init__(self, client: Bullet, arm: Arm) -> None:
        self.client, self.arm = client, arm
        self.q = self.motion("held", 40).thinned(40).shaft[-40:]
        self.t = np.arange(40.0)
        self.nominal = self.sight()

    def world(self, effect: str = "", where: str | None = None, source: str | None = None, /, **p: float) -> World:
        return World(self.client, self.arm, [Hidden(effect, where, source, p, "")] if effect else [])

    def sight(self, effect: str = "", where: str | None = None, source: str | None = None, /, **p: float) -> Sight:
        return self.world(effect, where, source, **p).standing(self.q, self.t)

    def motion(self, style: Style, pairs: int) -> Motion:
        world = self.world()
        return move(
            np.random.default_rng(9),
            style,
            self.arm.ranges,
            pairs,
            lambda q: in_view(self.arm.eyes, world.marker(q, np.zeros(len(q))), 20.0),
        )

    def column(self, joint: str) -> int:
        return self.arm.read.index(joint)


@pytest.fixture(scope="module")
def bench(client: Bullet, arm: Arm) -> Bench:
    return Bench(client, arm)


def test_an_offset_is_added_to_its_joint_alone(bench: Bench) -> None:
    off = bench.sight("joint_offset", "elbow", offset_rad=0.02).readings - bench.q
    np.testing.assert_allclose(off[:, bench.column("elbow")], 0.02)
    assert not np.delete(off, bench.column("elbow"), axis=1).any()


def test_scale_error_is_proportional_to_the_angle(bench: Bench) -> None:
    sight, k = bench.sight("joint_scale", "waist", scale=0.01), bench.column("waist")
    np.testing.assert_allclose(sight.readings[:, k], 1.01 * bench.q[:, k])


def test_coupling_moves_joint_but_not_its_reading(bench: Bench) -> None:
    coupled = bench.sight("joint_coupling", "wrist_bend", "elbow", ratio=0.03)
    q = bench.q.copy()
    q[:, bench.column("wrist_bend")] += 0.03 * q[:, bench.column("elbow")]
    np.testing.assert_array_equal(coupled.readings, bench.q)
    np.testing.assert_allclose(coupled.x, bench.world().standing(q, bench.t).x, atol=1e-12)


def test_an_encoder_jumps_at_its_moment(bench: Bench) -> None:
    off = bench.sight("encoder_jump", "shoulder", jump_rad=0.05, t0_s=19.5).readings - bench.q
    np.testing.assert_allclose(off[:, bench.column("shoulder")], np.where(bench.t > 19.5, 0.05, 0.0), atol=1e-12)


def test_joint_with_backlash_lags_its_last_move(bench: Bench) -> None:
    motion, k = bench.motion("held", 40), bench.column("waist")
    output = bench.world("backlash", "waist", play_rad=0.02).outputs(motion)
    behind = motion.at(motion.shaft - output, motion.stamps)[1:, k]
    moved_by = np.diff(motion.at(motion.shaft, motion.stamps)[:, k])
    far = np.abs(moved_by) > 0.02
    np.testing.assert_allclose(behind[far], 0.01 * np.sign(moved_by[far]), atol=1e-12)


def test_settling_error_is_proportional_to_last_move(bench: Bench) -> None:
    motion = bench.motion("held", 40)
    assert motion.move_s is not None
    assert motion.rest_s is not None
    world = bench.world("settling", "elbow", tau_s=0.15)
    k = bench.column("elbow")
    missing = motion.at(motion.shaft - world.outputs(motion), motion.stamps)[1:, k]
    moved = np.diff(motion.at(motion.shaft, motion.stamps)[:, k])
    np.testing.assert_allclose(missing, left_of_move(0.15, motion.move_s, motion.rest_s) * moved, rtol=1e-3, atol=1e-5)


def test_late_frame_shows_earlier_marker_position(bench: Bench) -> None:
    motion = bench.motion("walk", 100)
    late = bench.world("camera_latency", latency_s=0.05).measure(motion)
    earlier = motion.at(motion.shaft, motion.stamps - 0.05)
    np.testing.assert_allclose(late.x, bench.world().standing(earlier, motion.stamps).x, atol=1e-12)
    np.testing.assert_array_equal(late.readings, motion.at(motion.shaft, motion.stamps))


def pendulum(axis: tuple[float, float, float]) -> Arm:
    """Return one joint at a height of 1 m that carries 2 kg and the marker half a metre along x."""
    swing = Joint("swing", "revolute", BASE, "bob", axis=axis, lower=-1.5, upper=1.5)
    industrial_arm = industrial(np.random.default_rng(8))
    return replace(
        industrial_arm,
        joints=(Joint(MOUNT, "fixed", FLOOR, BASE, (0.0, 0.0, 1.0)), swing),
        masses={BASE: Mass(1.0), "bob": Mass(2.0, (0.5, 0.0, 0.0))},
        read=("swing",),
        ticks={"swing": 4096},
        marker_link="bob",
        marker_xyz=(0.5, 0.0, 0.0),
    )


def height(world: World, q: FloatArray) -> FloatArray:
    """Return the height of the marker above the floor [m]."""
    arm = world.arm
    c, R = np.array(arm.camera_xyz), rotation(arm)
    return (c + world.marker(q, np.zeros(len(q))) @ R.T)[:, 2]


def rotation(arm: Arm) -> FloatArray:
    """Return the rotation of the described left optical frame in the floor's frame."""
    return Rotation.from_euler("xyz", arm.camera_rpy).as_matrix()


def test_a_spring_gives_until_it_balances_the_weight(client: Bullet) -> None:
    arm, compliance = pendulum((0.0, 1.0, 0.0)), 0.01
    world = World(client, arm, [Hidden("joint_compliance", "swing", None, {"compliance_rad_per_Nm": compliance}, "")])
    q = np.linspace(-1.0, 1.0, 9)[:, None]
    below = (1.0 - height(world, q)) / 0.5  # the sine of the angle that the joint came to rest at
    given = np.arcsin(below) - q[:, 0]
    np.testing.assert_allclose(given, compliance * 2.0 * GRAVITY * 0.5 * np.sqrt(1.0 - below**2), atol=1e-9)


def test_compliance_about_vertical_axis_has_no_effect(client: Bullet) -> None:
    arm, q = pendulum((0.0, 0.0, 1.0)), np.linspace(-1.0, 1.0, 9)[:, None]
    spring = Hidden("joint_compliance", "swing", None, {"compliance_rad_per_Nm": 0.01}, "")
    t = np.zeros(len(q))
    np.testing.assert_allclose(
        World(client, arm, [spring]).marker(q, t), World(client, arm, []).marker(q, t), atol=1e-12
    )


@pytest.mark.parametrize(
    ("effect", "where", "p"),
    [
        ("joint_compliance", "shoulder", {"compliance_rad_per_Nm": 1e-3}),
        ("link_bend", "shoulder", {"bend_rad_per_Nm": 1e-3}),
        ("soft_mount", None, {"tilt_rad_per_Nm": 3e-4, "sink_m_per_N": 1e-5}),
    ],
)
def test_compliant_parts_let_the_hand_sink(bench: Bench, effect: str, where: str | None, p: dict[str, float]) -> None:
    stretched = np.tile([0.0, 0.9, 0.1, 0.0, 0.0, 0.0], (3, 1)) + np.array([[-0.5], [0.0], [0.5]]) * [1, 0, 0, 0, 0, 0]
    sunk = height(bench.world(), stretched) - height(bench.world(effect, where, **p), stretched)
    assert (sunk > 0.002).all()


def test_a_soft_mount_reads_as_before(bench: Bench) -> None:
    np.testing.assert_array_equal(bench.sight("soft_mount", tilt_rad_per_Nm=1e-3, sink_m_per_N=0.0).readings, bench.q)


def moved(bench: Bench, sight: Sight) -> FloatArray:
    """Return the distances by which the measured positions moved [m], shape (n,)."""
    return np.linalg.norm(sight.x - bench.nominal.x, axis=1)


@pytest.mark.parametrize("where", ["waist", "elbow", "flange_roll"])
def test_a_shifted_joint_shifts_the_marker_as_far(bench: Bench, where: str) -> None:
    np.testing.assert_allclose(
        moved(bench, bench.sight("link_geometry", where, **shifted(**NO_TURN))), np.linalg.norm(SHIFT), atol=1e-12
    )


def test_a_tilted_joint_turns_the_marker_about_itself(bench: Bench) -> None:
    p = {"dx_m": 0.0, "dy_m": 0.0, "dz_m": 0.0, "rx_rad": 0.02, "ry_rad": 0.0, "rz_rad": 0.01}
    off = moved(bench, bench.sight("link_geometry", "waist", **p))
    lever = bench.nominal.x @ rotation(bench.arm).T + bench.arm.camera_xyz - np.array(bench.arm.joint("waist").xyz)
    turned = np.linalg.norm(np.cross([p["rx_rad"], p["ry_rad"], p["rz_rad"]], lever), axis=1)
    np.testing.assert_allclose(off, turned, rtol=0.02)  # to first order in the tilt


def test_another_tool_moves_the_marker_as_far_everywhere(bench: Bench) -> None:
    off = bench.sight("tool_offset", **shifted()).x - bench.nominal.x
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), np.linalg.norm(SHIFT), atol=1e-12)
    assert np.std(off, axis=0).min() > 0.0  # in directions that turn with the hand


@pytest.mark.parametrize(
    ("effect", "p"), [("tool_slip", shifted(t0_s=19.5)), ("camera_moved", six((0.01, -0.02, 0.005), t0_s=19.5))]
)
def test_nothing_moves_before_the_moment(bench: Bench, effect: str, p: dict[str, float]) -> None:
    off = moved(bench, bench.sight(effect, **p))
    assert not off[bench.t < 19.5].any()
    assert (off[bench.t > 19.5] > 1e-3).all()


def test_slipped_marker_matches_a_tool_offset(bench: Bench) -> None:
    slipped, other = bench.sight("tool_slip", **shifted(t0_s=-1.0)), bench.sight("tool_offset", **shifted())
    np.testing.assert_allclose(slipped.x, other.x, atol=1e-12)


@pytest.mark.parametrize("effect", ["camera_pose", "camera_moved"])
def test_a_camera_elsewhere_sees_all_from_there(bench: Bench, effect: str) -> None:
    sight = bench.sight(effect, **six((0.01, -0.02, 0.005), t0_s=-1.0))
    apart = np.linalg.norm(sight.x[:, None] - sight.x, axis=2)
    np.testing.assert_allclose(apart, np.linalg.norm(bench.nominal.x[:, None] - bench.nominal.x, axis=2), atol=1e-9)
    assert moved(bench, sight).min() > 1e-3


def test_moved_camera_matches_the_equivalent_camera_pose(bench: Bench) -> None:
    p = six((0.01, -0.02, 0.005), t0_s=-1.0)
    np.testing.assert_allclose(bench.sight("camera_moved", **p).x, bench.sight("camera_pose", **p).x, atol=1e-9)


def test_longer_baseline_shrinks_all_measured_positions(bench: Bench) -> None:
    np.testing.assert_allclose(bench.sight("camera_scale", scale=0.02).x * 1.02, bench.nominal.x, atol=1e-12)


def test_a_longer_focal_length_shrinks_depth_alone(bench: Bench) -> None:
    sight = bench.sight("camera_focal", scale=0.02)
    np.testing.assert_allclose(sight.x * [1.0, 1.0, 1.02], bench.nominal.x, atol=1e-12)


def test_lens_distortion_grows_with_cubed_image_radius(bench: Bench) -> None:
    principal, focal = np.array(bench.arm.eyes.principal_point_px), bench.arm.eyes.focal_px
    ideal = bench.nominal.pixels[:, :2] - principal
    out = bench.sight("lens_distortion", k1=0.05, k2=0.0).pixels[:, :2] - principal
    r = np.linalg.norm(ideal, axis=1)
    np.testing.assert_allclose(np.linalg.norm(out, axis=1) - r, 0.05 * r**3 / focal**2, atol=1e-9)


def test_drift_reaches_63_percent_after_one_time_constant(bench: Bench) -> None:
    off = bench.sight("thermal_drift", **shifted(tau_s=10.0)).x - bench.nominal.x
    np.testing.assert_allclose(off[10], (1.0 - 1.0 / math.e) * np.array(SHIFT), atol=1e-9)


def test_fully_grown_link_matches_a_longer_link(bench: Bench) -> None:
    grown = bench.sight("growing_link", "elbow", **shifted(tau_s=1e-3))
    origin = bench.arm.joint("elbow")
    longer = bench.arm.with_joint(replace(origin, xyz=tuple(np.array(origin.xyz) + SHIFT)))
    x = World(bench.client, longer, []).standing(bench.q, bench.t).x
    np.testing.assert_allclose(grown.x[1:], x[1:], atol=1e-12)


ERRORS_BY_POSTURE: dict[str, tuple[dict[str, float], Callable[[FloatArray, FloatArray], FloatArray]]] = {
    "square_of_other": ({"amplitude": 0.02}, lambda _, other: 0.02 * other**2),
    "product_of_two": ({"amplitude": 0.02}, lambda own, other: 0.02 * own * other),
    "cable_touches": (
        {"amplitude": 0.02, "at": 0.1, "width": 0.2},
        lambda _, other: 0.02 * np.tanh((other - 0.1) / 0.2),
    ),
}


@pytest.mark.parametrize("effect", ERRORS_BY_POSTURE)
def test_an_error_by_posture_follows_its_law(bench: Bench, effect: str) -> None:
    p, law = ERRORS_BY_POSTURE[effect]
    own, other = bench.q[:, bench.column("elbow")], bench.q[:, bench.column("waist")]
    off = bench.sight(effect, "elbow", "waist", **p).readings - bench.q
    np.testing.assert_allclose(off[:, bench.column("elbow")], law(own, other), atol=1e-12)


def test_a_wandering_zero_changes_slowly(bench: Bench) -> None:
    world = bench.world("wandering_zero", "elbow", amplitude=0.01, seed=3.0, interval_s=10.0)
    t = np.linspace(0.0, 600.0, 6001)
    off = world.readings(np.zeros((len(t), 6)), t)[:, bench.column("elbow")]
    assert np.ptp(off) > 0.01
    assert np.abs(np.diff(off)).max() < 0.05 * np.ptp(off)


def test_a_squinting_eye_changes_distance_most(bench: Bench) -> None:
    off = np.abs(bench.sight("vergence", vergence_rad=0.002).x - bench.nominal.x)
    assert (off[:, 2] > 0.0).all()
    assert off[:, 2].mean() > 2.0 * off[:, :2].mean()


def test_two_effects_on_one_joint_add_up(bench: Bench) -> None:
    both = [
        Hidden("joint_offset", "elbow", None, {"offset_rad": 0.01}, ""),
        Hidden("joint_scale", "elbow", None, {"scale": 0.02}, ""),
    ]
    k = bench.column("elbow")
    off = World(bench.client, bench.arm, both).standing(bench.q, bench.t).readings[:, k] - bench.q[:, k]
    assert off == pytest.approx(0.01 + 0.02 * bench.q[:, k], abs=0.02 * 0.01 + 1e-12)
