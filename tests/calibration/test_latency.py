"""The camera's latency against the encoders, from a wiggle of the arm."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize_scalar

from bodyschema.calibration.latency import EARLIEST_S, LATEST_S, STEP_S, Latency, LatencyError, Wiggle, latency_of
from bodyschema.cli.hardware.wiggling import read_wiggle, wiggle_of, write_wiggle
from bodyschema.interfaces.errors import RecordingError
from bodyschema.robot.description import RobotDescription
from kbmaps import ChainParameters, ChainTolerances, RigidChain

ARM = RobotDescription.load(Path(__file__).parents[2] / "examples" / "desk_arm" / "robot.toml")
TICK_RAD = 2 * np.pi / 4096
POSE = np.array([0.1, 0.4, 0.6, 0.0])


def wiggle(seed: int, latency_s: float, noise_mm: float = 0.5, joints: int = 4, harmonics: int = 6) -> Wiggle:
    """Return 5 s of uneven motion of an arm that deviates from nominal: joint offsets of 3°, another tool."""
    rng = np.random.default_rng(seed)
    pace = 2 * np.pi * rng.uniform(0.3, 1.2, (joints, harmonics))
    width = 0.2 * rng.normal(size=(joints, harmonics)) * np.sqrt(2 / harmonics) / pace * 3.8
    phase = rng.uniform(0, 2 * np.pi, (joints, harmonics))

    def q(t: np.ndarray) -> np.ndarray:
        moved = np.sum(width * np.sin(pace * t[:, None, None] + phase), axis=2)
        return POSE + np.pad(moved, ((0, 0), (0, len(POSE) - joints)))

    t_joints = np.arange(500) / 100 + rng.normal(0, 5e-4, 500)
    t_marker = 0.013 + np.arange(150) / 30
    real = ARM.chain.with_tool(np.array(ARM.robot.marker_xyz) + rng.normal(0, 0.03, 3))
    x = real.positions(q(t_marker - latency_s) + np.radians(rng.normal(0, 3, 4)))
    noise = rng.normal(0, 1e-3 * noise_mm, x.shape) * [0.7, 0.7, 2.0]
    return Wiggle(t_joints, np.round(q(t_joints) / TICK_RAD) * TICK_RAD, t_marker, x + noise)


def latency_by_speed(wiggle: Wiggle, chain: RigidChain) -> float:
    """Return the latency [s] from speeds alone: the shift that best correlates the speeds of chain and marker.

    For comparison: the nominal arm's speed is not the real one's, and noise is differentiated.
    """
    t = wiggle.t_marker[(wiggle.t_marker - LATEST_S >= wiggle.t_joints[0])]
    x = wiggle.x[-len(t) :]
    middle, half = 0.5 * (t[1:] + t[:-1]), 0.5 * float(np.median(np.diff(t)))
    seen = np.linalg.norm(np.diff(x, axis=0), axis=1) / np.diff(t)

    def mismatch(lag: float) -> float:
        ends = [chain.positions(wiggle.angles(middle - lag + side)) for side in (half, -half)]
        return -float(np.corrcoef(np.linalg.norm(ends[0] - ends[1], axis=1), seen)[0, 1])

    grid = np.arange(EARLIEST_S, LATEST_S, STEP_S)
    best = grid[int(np.argmin([mismatch(lag) for lag in grid]))]
    found = minimize_scalar(mismatch, bounds=(best - STEP_S, best + STEP_S), method="bounded")
    return float(found.x)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    "latency_s", [0.033, *(pytest.param(latency_s, marks=pytest.mark.soak) for latency_s in (0.0, 0.12))]
)
def test_a_hidden_latency_is_found_to_two_milliseconds(latency_s) -> None:
    for seed in range(2):
        assert abs(latency_of(wiggle(seed, latency_s), ARM.chain).latency_s - latency_s) < 2e-3


@pytest.mark.parametrize("seeds", [4, pytest.param(12, marks=pytest.mark.soak)])
def test_the_claimed_uncertainty_covers(seeds) -> None:
    hidden = np.random.default_rng(5).uniform(0, 0.12, seeds)
    found = [latency_of(wiggle(seed, latency), ARM.chain) for seed, latency in enumerate(hidden.tolist())]
    off = np.array([(each.latency_s - latency) / each.sigma_s for each, latency in zip(found, hidden, strict=True)])
    assert (np.abs(off) < 3).all()
    assert np.sqrt(np.mean(off**2)) > 0.2  # and claims no more than there is


def guided(seed: int) -> Wiggle:
    """Return 12 s of hand guiding from pose to pose at one pace: joint offsets 2.5°, axes 0.6° and links 5 mm off."""
    rng = np.random.default_rng(seed)
    parameters = ChainParameters(ARM.chain)
    made = ChainTolerances(axes=0.01, points=0.005, zeros=0.045, tool=0.01)
    change = parameters.standard_deviations(made) * rng.normal(size=parameters.size)
    poses = POSE + rng.uniform(-0.8, 0.8, (12, 4))
    times = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(poses, axis=0), axis=1) / 0.87])
    path = PchipInterpolator(times, poses)
    t_joints, t_marker = np.arange(0.0, 12.0, 0.01), np.arange(0.0, 12.0, 1 / 30)
    x = parameters.positions(change, path(np.minimum(t_marker, times[-1])))
    q = np.round(path(np.minimum(t_joints, times[-1])) / TICK_RAD) * TICK_RAD
    return Wiggle(t_joints, q, t_marker, x + 2e-4 * rng.normal(size=x.shape) * [0.7, 0.7, 2.0])


def test_slow_guiding_recovers_latency_within_0_7_ms() -> None:
    assert all(abs(latency_of(guided(seed), ARM.chain).latency_s) < 0.7e-3 for seed in range(2))


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_slow_guiding_95_percent_intervals_cover_the_latency() -> None:
    found = list[Latency]()
    for seed in range(60):
        with suppress(LatencyError):  # too slow a motion
            found.append(latency_of(guided(seed), ARM.chain))
    assert len(found) > 50
    off = np.array([each.latency_s / each.sigma_s for each in found])
    print(f"rms {1e3 * np.sqrt(np.mean([each.latency_s**2 for each in found])):.2f} ms, off / sigma {np.sort(off)}")
    assert np.mean(np.abs(off) < 1.96) > 0.9
    assert np.sqrt(np.mean(off**2)) > 0.4  # and claims no more than there is


def in_step(seed: int, latency_s: float) -> Wiggle:
    """Return slow motion with noisy readings, every fourth of them exactly at the time of an image."""
    rng = np.random.default_rng(seed)
    pace = 2 * np.pi * rng.uniform(0.3, 1.2, (4, 6))
    width, phase = 0.18 * rng.normal(size=(4, 6)) / pace, rng.uniform(0, 2 * np.pi, (4, 6))

    def q(t: np.ndarray) -> np.ndarray:
        return POSE + np.sum(width * np.sin(pace * t[:, None, None] + phase), axis=2)

    t_joints, t_marker = np.arange(600) / 120, np.arange(150) / 30
    read = np.round(q(t_joints) / TICK_RAD + rng.normal(0, 0.3, (600, 4))) * TICK_RAD
    x = ARM.chain.positions(q(t_marker - latency_s) + np.radians(rng.normal(0, 3, 4)))
    return Wiggle(t_joints, read, t_marker, x + rng.normal(0, 1e-4, x.shape))


@pytest.mark.parametrize("seeds", [3, pytest.param(12, marks=pytest.mark.soak)])
@pytest.mark.parametrize("latency_s", [pytest.param(0.0, marks=pytest.mark.soak), 0.04])
def test_readings_synchronous_with_images_do_not_bias_latency(latency_s, seeds) -> None:
    """Check midpoints: a straight line between two readings has half their noise there and seems to fit best."""
    found = [latency_of(in_step(seed, latency_s), ARM.chain) for seed in range(seeds)]
    off = np.array([each.latency_s - latency_s for each in found])
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert (np.abs(off) < 2.0 * np.array([each.sigma_s for each in found])).mean() > 0.85


def test_angles_between_readings_are_neither_early_nor_late() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.006, 0.012, 100))
    moved = Wiggle(t, np.column_stack([1.0 + 2.0 * t, np.sin(5.0 * t)]), t, np.zeros((100, 3)))
    between = np.linspace(t[3], t[-4], 50)
    off = moved.angles(between) - np.column_stack([1.0 + 2.0 * between, np.sin(5.0 * between)])
    assert np.abs(off).max(axis=0) == pytest.approx([0.0, 0.0], abs=1e-3)
    slope = np.column_stack([np.full(50, 2.0), 5.0 * np.cos(5.0 * between)])
    assert np.abs(np.sum(off * slope, axis=0) / np.sum(slope**2, axis=0)).max() < 5e-5  # s


@pytest.mark.soak
def test_latency_estimate_beats_speed_correlation_over_many_seeds() -> None:
    hidden = np.random.default_rng(6).uniform(0, 0.12, 200)
    errors, by_speed, claimed, refused = [], [], [], 0
    for seed, latency in enumerate(hidden.tolist()):
        moved = wiggle(seed, latency)
        try:
            found = latency_of(moved, ARM.chain)
        except LatencyError:
            refused += 1
            continue
        errors.append(found.latency_s - latency)
        claimed.append(found.sigma_s)
        by_speed.append(latency_by_speed(moved, ARM.chain) - latency)
    rms, rms_by_speed = (1e3 * np.sqrt(np.mean(np.square(each))) for each in (errors, by_speed))
    within = np.mean(np.abs(errors) < np.array(claimed))
    worst = 1e3 * np.abs(errors).max()
    print(f"{refused} refused; rms {rms:.2f} ms, worst {worst:.2f} ms, 1 sigma covers {within:.0%}")
    print(f"by speeds alone: rms {rms_by_speed:.2f} ms")
    assert refused < 0.05 * len(hidden)
    assert worst < 2.5
    assert rms < rms_by_speed
    assert within > 0.65


def test_periodic_motion_is_rejected_as_repeating_itself() -> None:
    t_joints, t_marker = np.arange(500) / 100, np.arange(150) / 30
    q = np.tile(POSE, (500, 1))
    q[:, 0] += 0.3 * np.sin(2 * np.pi * 5 * t_joints)
    seen = np.tile(POSE, (150, 1))
    seen[:, 0] += 0.3 * np.sin(2 * np.pi * 5 * (t_marker - 0.04))
    x = ARM.chain.positions(seen) + np.random.default_rng(0).normal(0, 1e-3, (150, 3))
    with pytest.raises(LatencyError, match="repeats itself"):
        latency_of(Wiggle(t_joints, q, t_marker, x), ARM.chain)


def test_latency_far_beyond_the_search_fits_nowhere() -> None:
    with pytest.raises(LatencyError, match="do not go with them at any latency from -50 to 250 ms"):
        latency_of(wiggle(0, 0.6), ARM.chain)


def test_too_few_fixes_are_named() -> None:
    whole, few = wiggle(0, 0.05), slice(20, 32)
    hardly = Wiggle(whole.t_joints, whole.q, whole.t_marker[few], whole.x[few])
    with pytest.raises(LatencyError, match="was seen 12 times, 60 are needed"):
        latency_of(hardly, ARM.chain)


def shown(seed: int = 0, *, every: int = 1, seconds: float = 5.0) -> Wiggle:
    """Return the first `seconds` [s] of a wiggle with every `every`-th fix of the cameras."""
    whole = wiggle(seed, 0.05)
    joints, fixes = whole.t_joints < seconds, whole.t_marker < seconds
    return Wiggle(whole.t_joints[joints], whole.q[joints], whole.t_marker[fixes][::every], whole.x[fixes][::every])


def test_slow_camera_error_states_the_frame_rate() -> None:
    with pytest.raises(LatencyError, match=r"10\.0 images a second.*--seconds 8"):
        latency_of(shown(every=3), ARM.chain)


def test_too_short_recording_error_states_its_length() -> None:
    with pytest.raises(LatencyError, match=r"together for 1\.5 s only"):
        latency_of(shown(seconds=1.5), ARM.chain)


@pytest.mark.parametrize("share", [0.0, 0.01])
def test_joints_that_hardly_moved_are_named(share: float) -> None:
    """Check joints that moved by less than a tick."""
    moved = wiggle(0, 0.05)
    with pytest.raises(LatencyError, match="the joints hardly moved"):
        latency_of(Wiggle(moved.t_joints, POSE + share * (moved.q - POSE), moved.t_marker, moved.x), ARM.chain)


def test_joints_not_moving_the_marker_are_reported() -> None:
    """Check, for example, a wrist that turns a marker about its own axis."""
    moved = wiggle(0, 0.05)
    noise = np.random.default_rng(1).normal(0, 5e-4, moved.x.shape)
    with pytest.raises(LatencyError, match=r"the marker moved by [0-9.]+ mm only"):
        latency_of(Wiggle(moved.t_joints, moved.q, moved.t_marker, moved.x[:1] + noise), ARM.chain)


def test_a_marker_that_moves_by_itself_is_named() -> None:
    """Check another motion, as when the marker is moved by hand or the joints are in another order."""
    ours, others = wiggle(0, 0.05), wiggle(1, 0.05)
    with pytest.raises(LatencyError, match="does not follow the joints"):
        latency_of(Wiggle(ours.t_joints, ours.q, ours.t_marker, others.x), ARM.chain)


@pytest.mark.parametrize("latency_s", [-0.1, 0.3])
def test_a_latency_beyond_the_search_is_named(latency_s) -> None:
    with pytest.raises(LatencyError, match=r"agree best at (250|-50) ms, the end of the search"):
        latency_of(wiggle(0, latency_s), ARM.chain)


def test_without_readings_the_encoders_are_named() -> None:
    with pytest.raises(LatencyError, match="the encoders gave nothing"):
        wiggle_of([], [])


def test_wiggle_file_round_trip_is_exact(tmp_path) -> None:
    moved = wiggle(1, 0.05)
    write_wiggle(moved, ARM.joints, tmp_path / "wiggle.csv")
    back = read_wiggle(tmp_path / "wiggle.csv", ARM.joints)
    for name in ("t_joints", "q", "t_marker", "x"):
        assert np.array_equal(getattr(back, name), getattr(moved, name))


@pytest.mark.parametrize("row", ["0.1,,,,,,,", "0.1,1,2,3,4,5,6,7", "0.1,1,2,3,nothing,,,", "0.1"])
def test_malformed_wiggle_row_is_reported_with_its_line(tmp_path, row) -> None:
    file = tmp_path / "wiggle.csv"
    file.write_text(f"t,{','.join(ARM.joints)},x,y,z\n{row}\n")
    with pytest.raises(RecordingError, match="line 2"):
        read_wiggle(file, ARM.joints)
