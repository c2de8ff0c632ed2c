"""Write correction.json, from which a controller computes true joint angles and the marker's pose.

docs/exporting.md has the format, examples/correction its readers. It is a program of a few steps, each a table of
numbers. Every joint's frame is turned so that its axis is z.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.effects.effect import Effect
from bodyschema.effects.encoder import Rows
from bodyschema.effects.exports.arm_errors import geometry_without_zeros
from bodyschema.effects.gravity import GRAVITY_M_S2
from bodyschema.effects.simulation import SPRING_ROUNDS, Simulation
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import inverse

from .arm_errors import BORNE_BY_HAND, LeftOut, moment_notes, residual_note, sentences

FORMAT, VERSION = "bodyschema correction", 2


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
    held = kind.rigid or kind.is_spring or kind.is_load or _rows(simulation, effect) is not None
    return None if held else kind.no_counterpart


def _rows(simulation: Simulation, effect: Effect) -> Rows | None:
    return None if effect.where is None else effect.kind.correction_rows(effect, simulation.place(effect))


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
    head = {
        "format": FORMAT,
        "version": VERSION,
        "robot": simulation.robot.name,
        "from": heading,
        "notes": told,
        "joints": list(simulation.robot.joints),
    }
    entries = [f'"{name}": {json.dumps(value, ensure_ascii=False)}' for name, value in head.items()]
    for name, table in _tables(kept).items():
        rows = isinstance(table, list) and table and isinstance(table[0], list)
        entries.append(
            f'"{name}": ' + ("[\n  " + ",\n  ".join(map(json.dumps, table)) + "\n ]" if rows else f"{table}")
        )
    file.write_text("{\n " + ",\n ".join(entries) + "\n}\n", encoding="utf-8")
    return told


def _tables(simulation: Simulation) -> dict[str, Any]:
    """Return the steps of the program in the order in which they are done."""
    joints = simulation.robot.joints
    added: Rows = {name: [] for name in ("ratios", "waves", "memories", "loose")}
    zeros = [0.0] * len(joints)
    for effect in simulation.all_effects:
        if effect.kind.is_zero:
            zeros[simulation.place(effect).joint] += float(effect.values[0])
        for name, rows in (_rows(simulation, effect) or {}).items():
            added[name] += rows
    loose, springs = added.pop("loose"), simulation.springs if simulation.bears_weight else np.zeros(len(joints))
    added["ratios"] = [[k, k, 1.0] for k in range(len(joints))] + added["ratios"]
    gravity: dict[str, Any] = {"gravity": [0.0, 0.0, -GRAVITY_M_S2]}
    return {"zeros": zeros, **added} | gravity | _weights(simulation, springs, loose) | _chain(simulation)


def _weights(simulation: Simulation, springs: FloatArray, loose: list[list[Any]]) -> dict[str, Any]:
    """Return the bodies that joints carry, and their loads; none where no joint gives.

    Those of `bodies` have joints that give or bear one that does: first those that bear none in turn.
    """
    robot, gravity, geometry = simulation.robot, simulation.gravity, geometry_without_zeros(simulation)
    masses = [load.bodies for load in (gravity, *simulation.payloads)]
    gives = {int(k) for k in np.flatnonzero(springs)} | {joint for joint, *_ in loose}
    bearers: dict[int | None, set[int]] = {None: set()}
    for k in gravity.outwards:
        bearers[k] = bearers[gravity.bodies[k].carrier] | {k}
    inside = [k for k in gravity.outwards if not bearers[k] & gives and any(k in bearers[each] for each in gives)]
    between = [k for k in gravity.outwards if bearers[k] & gives and any(k in bearers[each] for each in gives)]
    outside = [k for k in gravity.outwards if bearers[k] & gives and k not in between]
    numbers: dict[int | None, int] = {None: 0} | {k: n for n, k in enumerate([*inside, *between, *outside], 1)}
    aligned: dict[int | None, FloatArray] = {None: np.eye(4)}
    aligned |= {k: _onto_z(robot.tree.joint(name).axis) for k, name in enumerate(robot.joints)}
    passes = [[0, len(inside)]] * (SPRING_ROUNDS * bool(springs.any())) + [[1, len(inside)]] * bool(loose)
    found: dict[str, Any] = {"loads": [[0.0] * 4], "carried": [], "passes": passes, "bodies": []}
    for k in [*inside, *between, *outside]:
        name, body = robot.joints[k], gravity.bodies[k]
        joint = robot.tree.joint(name)
        origin = geometry.T_parent_joint.get(name, joint.T_parent_joint)
        T = inverse(aligned[body.carrier]) @ body.T_carrier_joint @ inverse(joint.T_parent_joint) @ origin @ aligned[k]
        parent, slides, pose = numbers[body.carrier], int(robot.chain.prismatic[k]), _numbers(T)
        moment = aligned[k][:3, :3].T @ sum(each[k].moment for each in masses)
        found["loads"].append([*moment.tolist(), float(sum(each[k].mass_kg for each in masses))])
        half, hold = next(((half, hold) for at, half, hold in loose if at == k), (0.0, 0.0))
        if k in outside:
            found["carried"].insert(0, [k, numbers[k], parent, slides, pose])
        else:
            found["bodies"].append([k, parent, slides, pose, [float(springs[k]), half, hold, 0.0]])
    return found


def _chain(simulation: Simulation) -> dict[str, list[Any]]:
    """Return the joints from camera to marker, each with the pose of its frame in that of the one before."""
    own, background = (
        [effect for effect in effects if not effect.kind.is_zero]
        for effects in (simulation.effects, simulation.background)
    )
    chain = simulation.with_effects(own).with_background(background).rigid_chain
    before, joints = np.eye(4), []
    for fixed, axis, slides in zip(chain.fixed, chain.axes, chain.prismatic, strict=False):
        onto_z = _onto_z(axis)
        joints.append([int(slides), _numbers(before.T @ fixed @ onto_z)])
        before = onto_z
    return {"chain": joints, "marker": (before.T @ chain.fixed[-1]).T.tolist()}


def _onto_z(axis: FloatArray) -> FloatArray:
    """Return a rotation (4, 4) whose z is `axis`."""
    across = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    return T


def _numbers(T: FloatArray) -> list[float]:
    """Return the upper three rows of a pose, row by row."""
    return T[:3].ravel().tolist()
