"""The rendered world agrees with `bodyschema.effects.Simulation`, effect by effect."""

from __future__ import annotations

import numpy as np
import pytest
from guided_run import NoRenderer
from test_sim_truth import NO_ERRORS

from bodyschema.effects import EFFECT_TYPES, Effect, Motion, Simulation
from bodyschema.interfaces.records import MarkerFix
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from bodyschema.sim_backend import EncoderConfig, SimConfig, model_file
from bodyschema.sim_backend.physics import JointPaths, Physics
from bodyschema.sim_backend.posed import PosedWorld, visible_postures
from bodyschema.sim_backend.truth import TrueRobot
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tracked_camera import TrackedCamera

CLOSE_M = 1e-6
LIMIT_S = 500.0  # a busy machine may take half a minute to start the renderer
FRAME_STEPS = 8
# After this many frames, nothing depends on the state before the first.
FORGOTTEN = 25
# Readings as fine as numbers are, at every step of the physics.
EXACT = EncoderConfig(ticks_per_turn=2**44, ticks_per_metre=2**44, noise_ticks=0.0, rate_hz=240)
CONFIG = SimConfig(seed=4, errors=NO_ERRORS, encoders=EXACT)
SHIFT = {"x_m": 0.011, "y_m": -0.007, "z_m": 0.009}
TURN = {"rx_rad": 0.03, "ry_rad": -0.02, "rz_rad": 0.05}
HEAD, ARM = "neck_pitch", "elbow_flexion"
EFFECTS = [
    ("joint_offset", HEAD, None, {"offset_rad": 0.04}),
    ("joint_offset", ARM, None, {"offset_rad": -0.05}),
    ("joint_scale", ARM, None, {"scale_error": 0.02}),
    ("joint_eccentricity", ARM, None, {"sine_rad": 0.02, "cosine_rad": -0.01}),
    ("joint_ripple", ARM, None, {"sine_rad": 0.01, "cosine_rad": 0.004, "cycles_per_turn": 11.0}),
    ("joint_coupling", ARM, "shoulder_flexion", {"ratio": 0.03}),
    ("encoder_jump", ARM, None, {"jump_rad": 0.03, "t0": 0.6}),
    ("backlash", ARM, None, {"width_rad": 0.01}),
    ("backlash", HEAD, None, {"width_rad": 0.02}),
    ("settling", ARM, None, {"fraction": 0.1, "memory": 0.3}),
    ("hysteresis", ARM, None, {"lag_rad": 0.01, "length_rad": 0.03}),
    ("joint_compliance", ARM, None, {"compliance_rad_per_Nm": 0.004}),
    ("joint_compliance", "shoulder_flexion", None, {"compliance_rad_per_Nm": 0.002}),
    ("gravity_backlash", ARM, None, {"width_rad": 0.01, "hold_Nm": 0.0}),
    ("payload", None, None, {"mass_kg": 0.5, "x_kgm": 0.02, "y_kgm": 0.0, "z_kgm": 0.03}),
    ("link_geometry", HEAD, None, SHIFT | TURN),
    ("link_geometry", ARM, None, SHIFT | TURN),
    ("tool_offset", None, None, SHIFT),
    ("tool_slip", None, None, SHIFT | {"t0": 0.7}),
    ("camera_pose", None, None, SHIFT | TURN),
    ("camera_moved", None, None, SHIFT | TURN | {"t0": 0.8}),
    ("camera_scale", None, None, {"scale_error": 0.02}),
    ("camera_focal", None, None, {"focal_error": 0.015}),
    ("camera_refocused", None, None, {"focal_error": 0.015, "t0": 0.8}),
    ("lens_distortion", None, None, {"k1": 0.08, "k2": -0.03}),
    ("camera_latency", None, None, {"latency_s": 0.0125}),
    ("thermal_drift", None, None, SHIFT | {"time_constant_s": 0.5}),
]  # fmt: skip


# Effects on images on their way to the tracker.
SEEN = (("camera_scale", "camera_focal", "lens_distortion"), ("camera_moved", "thermal_drift"))
# Those without a memory of their own go through the same lines of the guided world.
TOGETHER = (
    {"joint_scale", "joint_eccentricity", "joint_ripple", "joint_coupling"},
    {"joint_compliance", "payload"},
    {"tool_offset", "camera_pose", "camera_scale", "camera_focal", "lens_distortion"},
    {"joint_offset", "link_geometry"},
    {"tool_slip", "camera_moved", "camera_refocused", "thermal_drift"},
    {"backlash"},
)


def groups() -> list[list]:
    """Return the groups of effects that the guided world tries together, then each other effect alone."""
    grouped = [[case for case in EFFECTS if case[0] in names] for names in TOGETHER]
    alone = [case for case in EFFECTS if not any(case[0] in names for names in TOGETHER)]
    return grouped + [[case] for case in alone if case[0] != "camera_latency"]  # whose formula holds for smooth paths


def named(case) -> str:
    return f"{case[0]}-{case[1]}" if case[1] else case[0]


def held() -> RobotDescription:
    """Return the shipped robot, whose joints hold its weight."""
    file = model_file("upper_body")
    tables, text = read_toml(file)
    tables["robot"]["hold"] = "held"
    return RobotDescription.from_tables(tables, text, file)


def extended(*cases) -> Simulation:
    robot = held()
    return Simulation(robot, tuple(Effect.at(robot, *case) for case in cases))


def guided(simulation: Simulation, config: SimConfig = CONFIG, seconds: float = 1.0) -> tuple[Motion, np.ndarray]:
    """Return readings at every step from the start, and an ideal tracker's positions; NaN between frames."""
    robot = simulation.robot
    assert robot.calibration is not None
    truth = TrueRobot.draw(robot, config, simulation)
    with Physics(truth, robot.calibration, config) as physics:
        q, x = [physics.read_encoders()], [np.full(3, np.nan)]
        while physics.steps < seconds * physics.rate_hz:
            physics.step()
            q.append(physics.read_encoders())
            x.append(physics.scene().x_seen if physics.steps % FRAME_STEPS == 0 else np.full(3, np.nan))
    t = np.arange(len(q)) / physics.rate_hz
    return Motion(np.array(q), t, np.zeros(len(q), dtype=np.int64), FRAME_STEPS / physics.rate_hz), np.array(x)


def frames(motion: Motion) -> Motion:
    """Return the rows at which frames were taken."""
    at = slice(FRAME_STEPS, None, FRAME_STEPS)
    assert motion.t is not None
    return Motion(motion.q[at], motion.t[at], motion.segment[at])


def test_every_effect_of_the_table_is_tried() -> None:
    assert {case[0] for case in EFFECTS} == set(EFFECT_TYPES)


@pytest.mark.parametrize("cases", groups(), ids=lambda cases: "-".join(map(named, cases)))
def test_guided_world_matches_the_simulation(cases) -> None:
    simulation = extended(*cases)
    motion, x = guided(simulation)
    at = slice(FRAME_STEPS, None, FRAME_STEPS)
    if cases[0][0] == "settling":  # of the moves between frames, of which the first frame knows nothing
        expected, seen = simulation.positions(frames(motion))[FORGOTTEN:], x[at][FORGOTTEN:]
    else:
        expected, seen = simulation.positions(motion)[at], x[at]
    assert np.abs(seen - expected).max() < CLOSE_M


def test_late_frame_shows_past_joint_angles() -> None:
    simulation, steps = extended(("camera_latency", None, None, {"latency_s": 3 / 240})), 3
    motion, x = guided(simulation)
    past = simulation.robot.chain.positions(motion.q[FRAME_STEPS - steps :: FRAME_STEPS])
    assert np.abs(x[FRAME_STEPS::FRAME_STEPS] - past[: len(x[FRAME_STEPS::FRAME_STEPS])]).max() < CLOSE_M


@pytest.mark.parametrize("latency_s", [0.0125, 0.031, -0.031])
def test_late_stamp_on_smooth_path_matches_simulation(latency_s: float) -> None:
    simulation = extended(("camera_latency", None, None, {"latency_s": latency_s}))
    truth = TrueRobot.draw(simulation.robot, CONFIG, simulation)
    paths = JointPaths(truth, 240, 30, begins=0.0)
    t = np.arange(120) / 240
    speeds, bends = np.random.default_rng(5).uniform(-1, 1, (2, len(simulation.robot.joints), 1))
    drives = (speeds * t + bends * t**2).T
    read, seen = [], []
    for angles, now in zip(drives, t, strict=True):
        paths.record(angles, float(now))
        read.append(paths.read)
        seen.append(paths.seen)
    motion = Motion(np.array(read), t, np.zeros(len(t), dtype=np.int64))
    well_inside = slice(20, -20)  # where the lag leads to no moment before the first or after the last row
    said = motion.earlier(simulation.latency_s).q
    assert np.abs(np.array(seen) - said)[well_inside].max() < 1e-5  # the path between readings is not known exactly


@pytest.mark.parametrize("case", [case for case in EFFECTS if case[0] != "camera_latency"], ids=named)
def test_posed_world_matches_the_simulation(case, monkeypatch) -> None:
    monkeypatch.setattr("bodyschema.sim_backend.posed.RenderProcess", NoRenderer)
    simulation = extended(case)
    robot = simulation.robot
    rng = np.random.default_rng(3)
    postures = rng.uniform(0.7 * robot.lower, 0.7 * robot.upper, (40, len(robot.joints)))
    postures[:, 0:2] = 0.0  # the head looks ahead
    with PosedWorld(robot, CONFIG, postures, simulation) as world:
        x = np.array([world.scene(number).x_seen for number in range(len(postures))])
    motion = Motion(postures, np.arange(1.0, 41.0), np.zeros(40, dtype=np.int64))
    x_camera = simulation.run(motion).x_camera
    ahead = x_camera[:, 2] > np.abs(x_camera[:, :2]).max(axis=1)  # within 45° of the axis
    assert ahead.any()
    assert np.abs(x - simulation.positions(motion))[ahead].max() < CLOSE_M


def doubled(case):
    name, where, source, values = case
    return (
        name,
        where,
        source,
        {key: value if key == "time_constant_s" else 2.0 * value for key, value in values.items()},
    )


@pytest.mark.parametrize(
    "names", [SEEN[0], *(pytest.param(names, marks=pytest.mark.soak) for names in SEEN[1:])], ids="-".join
)
def test_tracker_measures_the_effects_shown_by_world(names) -> None:
    simulation = extended(*(doubled(case) for case in EFFECTS if case[0] in names))
    plain = SimConfig(seed=4, errors=NO_ERRORS)
    postures = visible_postures(simulation.robot, plain, 6)
    with PosedWorld(simulation.robot, plain, postures, simulation) as world:
        tracked = TrackedCamera(world.camera, StereoTracker(world.camera.calibration, VisionConfig()))
        shown = np.array([world.scene(number).x_seen for number in range(len(postures))])
        with tracked:
            fixes = [tracked.read(LIMIT_S) for _ in postures]
    seen = [k for k, fix in enumerate(fixes) if isinstance(fix, MarkerFix)]
    misses = np.array([fixes[k].x for k in seen]) - shown[seen]
    effects = shown[seen] - simulation.robot.chain.positions(postures[seen])
    assert len(seen) >= 3
    # A tenth of a pixel is two millimetres of depth at this distance.
    assert np.linalg.norm(misses, axis=1).mean() < 0.1 * np.linalg.norm(effects, axis=1).mean()
