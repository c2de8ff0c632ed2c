"""The effects of the table: place, random parameters and meaning of the signs of each."""

from __future__ import annotations

import numpy as np

from .hidden import Kind, Parameters, Site, direction, moment, sign

START = 0.003  # initial amplitude, scaled later


def _offset(site: Site, rng: np.random.Generator) -> Parameters:
    return {f"offset_{site.unit}": START * sign(rng)}


def _scale(_: Site, rng: np.random.Generator) -> Parameters:
    return {"scale": START * sign(rng)}


def _eccentricity(site: Site, rng: np.random.Generator) -> Parameters:
    ex, ey = START * direction(rng, 2)
    turn = {"turn_m": float(rng.uniform(0.1, 0.3))} if site.prismatic else {}
    return {"ex": float(ex), "ey": float(ey), **turn}


def _ripple(site: Site, rng: np.random.Generator) -> Parameters:
    bias_sine, bias_cosine = START * direction(rng, 2)
    turn = {"turn_m": float(rng.uniform(0.1, 0.3))} if site.prismatic else {}
    most = 10.0 if site.prismatic else 80.0
    poles = float(np.rint(np.exp(rng.uniform(np.log(2.0), np.log(most)))))
    return {"poles": poles, "bias_sine": float(bias_sine), "bias_cosine": float(bias_cosine), **turn}


def _coupling(_: Site, rng: np.random.Generator) -> Parameters:
    return {"ratio": START * sign(rng)}


def _jump(site: Site, rng: np.random.Generator) -> Parameters:
    return {f"jump_{site.unit}": START * sign(rng), "t0_s": moment(site, rng)}


def _play(site: Site, rng: np.random.Generator) -> Parameters:
    return {f"play_{site.unit}": START}


def _settling(site: Site, rng: np.random.Generator) -> Parameters:
    move, rest = site.motion.move_s, site.motion.rest_s
    if move is None or rest is None:
        return {"tau_s": START}
    return {"left": START, "move_s": move, "rest_s": rest}


def _compliance(site: Site, rng: np.random.Generator) -> Parameters:
    return {"compliance_m_per_N" if site.prismatic else "compliance_rad_per_Nm": 1e-4}


def _geometry(_: Site, rng: np.random.Generator) -> Parameters:
    shift, tilt = np.zeros(3), np.zeros(3)
    what = rng.integers(3)  # a length, an axis, both
    if what != 1:
        shift = START * direction(rng)
    if what != 0:
        tilt = 2.0 * START * direction(rng)
    return _six(shift, tilt)


def _six(shift: np.ndarray, tilt: np.ndarray) -> Parameters:
    names = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
    return {name: float(value) for name, value in zip(names, np.concatenate([shift, tilt]), strict=True)}


def _pose(_: Site, rng: np.random.Generator) -> Parameters:
    return _six(START * direction(rng), START * direction(rng))


def _moved(site: Site, rng: np.random.Generator) -> Parameters:
    return {**_pose(site, rng), "t0_s": moment(site, rng)}


def _tool(_: Site, rng: np.random.Generator) -> Parameters:
    return {name: float(value) for name, value in zip(SHIFT, START * direction(rng), strict=True)}


def _slip(site: Site, rng: np.random.Generator) -> Parameters:
    return {**_tool(site, rng), "t0_s": moment(site, rng)}


def _lens(_: Site, rng: np.random.Generator) -> Parameters:
    return {"k1": START * sign(rng), "k2": START * float(rng.choice([0.0, 0.0, 0.3, -0.3]))}


def _latency(_: Site, rng: np.random.Generator) -> Parameters:
    return {"latency_s": 0.005}


def _drift(site: Site, rng: np.random.Generator) -> Parameters:
    return {**_tool(site, rng), "tau_s": float(rng.uniform(0.1, 0.6)) * site.duration_s}


def _outliers(_: Site, rng: np.random.Generator) -> Parameters:
    return {"fraction": float(rng.uniform(0.01, 0.1))}


SHIFT = ("dx_m", "dy_m", "dz_m")
SIX = (*SHIFT, "rx_rad", "ry_rad", "rz_rad")

KINDS: dict[str, Kind] = {
    "joint_offset": Kind(
        "joint", ("offset_rad", "offset_m"), _offset, 0.2, "reading minus true position, the same at every position"
    ),
    "joint_scale": Kind(
        "joint", ("scale",), _scale, 0.1, "reading is (1 + scale) times the true position, zero stays zero"
    ),
    "joint_eccentricity": Kind(
        "joint",
        ("ex", "ey"),
        _eccentricity,
        0.2,
        "centre of the field displaced by (ex, ey) ring radii: reading = atan2(sin q + ey, cos q + ex) of the true "
        "angle q, so reading minus true is about ey cos q − ex sin q; a sliding joint turns the ring once per turn_m",
    ),
    "joint_ripple": Kind(
        "joint",
        ("bias_sine", "bias_cosine"),
        _ripple,
        0.3,
        "reading = atan2(sin Nq + bias_sine, cos Nq + bias_cosine) / N of the true angle q with N = poles a turn: "
        "reading minus true is about (bias_sine cos Nq − bias_cosine sin Nq) / N; a slide turns once per turn_m",
    ),
    "joint_coupling": Kind(
        "pair", ("ratio",), _coupling, 0.2, "true position minus reading, per position of the source joint"
    ),
    "encoder_jump": Kind(
        "joint", ("jump_rad", "jump_m"), _jump, 0.2, "reading minus true position from t0 on, whole ticks; 0 before"
    ),
    "backlash": Kind(
        "joint",
        ("play_rad", "play_m"),
        _play,
        0.1,
        "whole width of the play: the output lies within ±half of the reading",
    ),
    "settling": Kind(
        "joint",
        ("left", "tau_s"),
        _settling,
        0.5,
        "left is the part of the last move that the output still lacks when it is read: rest_s after the end of a move "
        "that took move_s; tau_s is the time constant with which it follows; a walk without rests has tau_s alone",
    ),
    "joint_compliance": Kind(
        "joint",
        ("compliance_rad_per_Nm", "compliance_m_per_N"),
        _compliance,
        0.02,
        "true position minus reading, per gravity torque that pulls the joint that way",
        bears=True,
    ),
    "link_geometry": Kind(
        "joint",
        SIX,
        _geometry,
        0.1,
        "the true joint's frame in the frame that the URDF gives it: shift, and turn as a rotation vector",
    ),
    "tool_offset": Kind("robot", SHIFT, _tool, 0.15, "true minus described marker, in the marker's link"),
    "tool_slip": Kind("robot", (*SHIFT,), _slip, 0.1, "marker after t0 minus before, in the marker's link"),
    "camera_pose": Kind(
        "robot",
        SIX,
        _pose,
        0.2,
        "the true left optical frame in the described one: shift, and turn as a rotation vector",
    ),
    "camera_moved": Kind(
        "robot",
        SIX,
        _moved,
        0.15,
        "the left optical frame after t0 in that before: shift, and turn as a rotation vector",
    ),
    "camera_scale": Kind("robot", ("scale",), _scale, 0.1, "the true baseline is (1 + scale) times the described one"),
    "camera_focal": Kind(
        "robot", ("scale",), _scale, 0.1, "the true focal length is (1 + scale) times the described one"
    ),
    "lens_distortion": Kind(
        "robot", ("k1", "k2"), _lens, 0.2, "Brown: the true image point is (1 + k1 r² + k2 r⁴) times the ideal one"
    ),
    "camera_latency": Kind(
        "robot", ("latency_s",), _latency, 0.3, "a frame is stamped this much after it was taken", styles=("walk",)
    ),
    "thermal_drift": Kind(
        "robot",
        SHIFT,
        _drift,
        0.1,
        "measured minus true position at the drift's end, in the measurement frame; before that times 1 − exp(−t/tau), "
        "t since the first sample",
    ),
    "outliers": Kind("robot", (), _outliers, 1.0, "fraction of the fixes that are not the marker"),
}
