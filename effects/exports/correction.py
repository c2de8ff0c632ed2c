"""Write correction.json, from which a controller computes true joint angles and the marker's pose.

docs/exporting.md has the format, examples/correction its readers. Every joint's frame is turned so that its axis is z.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.effects.effect import Effect
from bodyschema.effects.exports.arm_errors import geometry_without_zeros
from bodyschema.effects.gravity import GRAVITY_M_S2, carried
from bodyschema.effects.simulation import Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import inverse

from .arm_errors import BORNE_BY_HAND, LeftOut, moment_notes, residual_note, sentences

FORMAT, VERSION = "bodyschema correction", 1


def held_by_correction(simulation: Simulation) -> Simulation:
    """Return the simulation with only the effects that correction.json holds."""
    stayed = simulation.after_moments
    own, background = (
        tuple(effect for effect in effects if _why_not(stayed, effect) is None)
        for effects in (stayed.effects, stayed.background)
    )
    return Simulation(simulation.robot, own, None, background)


def _why_not(simulation: Simulation, effect: Effect) -> str | None:
    """Return the reason why the format cannot hold an effect; None if it can."""
    kind = effect.kind
    if kind.needs_weight and not simulation.bears_weight:
        return BORNE_BY_HAND
    held = kind.rigid or kind.is_spring or kind.is_load or kind.correction_values(effect) is not None
    return None if held else kind.no_counterpart


def write_correction(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write the simulation's correction of readings to `file`.

    Args:
        heading: one line that names the origin.

    Returns:
        Sentences on what the file does not hold, or holds in another form.

    Raises:
        OSError: the file cannot be written.
    """
    kept, stayed = held_by_correction(simulation), simulation.after_moments
    reasons = [(effect, _why_not(stayed, effect)) for effect in stayed.all_effects]
    left_out = [LeftOut(effect, why) for effect, why in reasons if why is not None]
    told = [*sentences(left_out), *residual_note(simulation), *moment_notes(simulation)]
    entries = [(effect, effect.kind.correction_values(effect)) for effect in kept.all_effects]
    contents = {
        "format": FORMAT,
        "version": VERSION,
        "robot": simulation.robot.name,
        "from": heading,
        "notes": told,
        "effects": [_entry(kept, effect, values) for effect, values in entries if values is not None],
        "gravity_m_s2": GRAVITY_M_S2,
    } | _chain(kept)
    file.write_text(json.dumps(contents, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return told


def _entry(simulation: Simulation, effect: Effect, values: list[float]) -> dict[str, Any]:
    place = simulation.place(effect)
    # Some effects have a state; it is unknown before the first reading.
    entry = {"effect": effect.name, "joint": place.joint, "values": values, "state": []}
    return entry if place.source is None else entry | {"source": place.source}


def _chain(simulation: Simulation) -> dict[str, Any]:
    """Return the joints, in the order of the readings, and the frames of camera and marker."""
    robot, gravity, geometry = simulation.robot, simulation.gravity, geometry_without_zeros(simulation)
    loads = [load.bodies for load in (gravity, *simulation.payloads)]
    aligned: dict[int | None, FloatArray] = {None: np.eye(4)}
    for k, name in enumerate(robot.joints):
        aligned[k] = _onto_z(robot.tree.joint(name).axis)
    joints = []
    for k, name in enumerate(robot.joints):
        joint, body = robot.tree.joint(name), gravity.bodies[k]
        origin = geometry.T_parent_joint.get(name, joint.T_parent_joint)
        pose = body.T_carrier_joint @ inverse(joint.T_parent_joint) @ origin
        joints.append(
            {
                "name": name,
                "slides": bool(robot.chain.prismatic[k]),
                "parent": _numbered(body.carrier),
                "pose": _numbers(inverse(aligned[body.carrier]) @ pose @ aligned[k]),
                "compliance": float(simulation.springs[k]),
                "mass_kg": float(sum(bodies[k].mass_kg for bodies in loads)),
                "moment_kg_m": (aligned[k][:3, :3].T @ sum(bodies[k].moment for bodies in loads)).tolist(),
            }
        )
    T_link_marker = np.eye(4)
    T_link_marker[:3, 3] = geometry.marker_xyz
    ends = {
        "camera": (robot.camera.parent_link, geometry.T_parent_camera),
        "marker": (robot.robot.marker_link, T_link_marker),
    }
    found: dict[str, Any] = {"joints": joints, "outwards": list(gravity.outwards)}
    for name, (link, T) in ends.items():
        carrier, T_carrier_link = carried(robot.tree, link, robot.joints, robot.robot.held_at)
        found[name] = {
            "parent": _numbered(carrier),
            "pose": _numbers(inverse(aligned[carrier]) @ T_carrier_link @ T),
        }
    return found


def _onto_z(axis: FloatArray) -> FloatArray:
    """Return a pose (4, 4) whose z is `axis`."""
    across = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    return T


def _numbered(carrier: int | None) -> int:
    return -1 if carrier is None else carrier


def _numbers(T: FloatArray) -> list[float]:
    """Return the upper three rows of a pose, row by row."""
    return T[:3].ravel().tolist()
