"""Write correction.json, from which a controller computes true joint angles and the marker's pose.

docs/exporting.md has the format, examples/correction its readers. It is a program of steps that fill registers. Every
joint's frame is rotated so that its axis is z.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodyschema.effects.effect_type import Effect
from bodyschema.effects.exports.arm_errors import geometry_without_zeros
from bodyschema.effects.gravity import GRAVITY_M_S2
from bodyschema.effects.joint_errors import Rows
from bodyschema.effects.simulation import Simulation, SimulationSettings
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import inverse

from .arm_errors import HELD_BY_HAND, LeftOut, moment_notes, residual_note, sentences

FORMAT = "bodyschema correction 3"
PACE, POSE, ANGLES = 2, 3, 15  # Registers that every file has: 0 is the number of joints, 1 of registers
# Steps by number; from OUTWARDS on for one row, two, three.
ADD, ADD_THREE, WAVE, MEMORY, TORQUE, SIDE, INWARDS, OUTWARDS = range(8)
OUTWARDS_THREE = OUTWARDS + 2
WIDEST = 12  # behind the last register, so that a step finds all that it takes in a row


def supported_effects(simulation: Simulation) -> Simulation:
    """Return the simulation with only the effects that correction.json holds."""
    permanent = simulation.with_permanent_changes
    own, background = (
        tuple(effect for effect in effects if _reason_left_out(permanent, effect) is None)
        for effects in (permanent.effects, permanent.background)
    )
    return Simulation(simulation.robot, own, None, background)


def _reason_left_out(simulation: Simulation, effect: Effect) -> str | None:
    """Return the reason why the format cannot hold an effect; None if it can."""
    kind = effect.kind
    if kind.needs_weight and not simulation.bears_weight:
        return HELD_BY_HAND
    held = kind.rigid or kind.is_spring or kind.is_load or _rows(simulation, effect) is not None
    return None if held else kind.no_counterpart


def _rows(simulation: Simulation, effect: Effect) -> Rows | None:
    return None if effect.where is None else effect.kind.correction_rows(effect, simulation.place(effect))


def write_correction(
    simulation: Simulation, file: Path, heading: str, pose_covariance: list[float] | None = None
) -> list[str]:
    """Write the simulation's correction of readings to `file`.

    Args:
        heading: one line that names the origin.
        pose_covariance: covariance of the file's poses, 6 x 6 row by row; None if unknown.

    Returns:
        Sentences on effects that the file does not hold, or holds in another form.

    Raises:
        OSError: the file cannot be written.
    """
    kept, permanent = supported_effects(simulation), simulation.with_permanent_changes
    reasons = [(effect, _reason_left_out(permanent, effect)) for effect in permanent.all_effects]
    left_out = [LeftOut(effect, why) for effect, why in reasons if why is not None]
    told = [*sentences(left_out), *residual_note(simulation), *moment_notes(simulation)]
    program = _Program(len(simulation.robot.joints))
    _add_encoders(kept, program)
    _add_weights(kept, program)
    _add_chain(kept, program)
    head = {
        "format": FORMAT,
        "robot": simulation.robot.name,
        "from": heading,
        "notes": told,
        "joints": list(simulation.robot.joints),
        "pose_covariance": pose_covariance,
    }
    entries = [f'"{name}": {json.dumps(value, ensure_ascii=False)}' for name, value in head.items()]
    file.write_text("{\n " + ",\n ".join([*entries, f'"numbers": {program}']) + "\n}\n", encoding="utf-8")
    return told


class _Program:
    """Registers and the steps that fill them, as docs/exporting.md describes them."""

    def __init__(self, joints: int) -> None:
        self.readings = range(ANGLES + joints, ANGLES + 2 * joints)
        # register of each joint's true angle after the steps so far
        self.angles = list(range(ANGLES, ANGLES + joints))
        self._registers = [0.0] * self.readings.stop
        self._steps: list[tuple[int, int, int, int, int]] = []
        self._constants: dict[tuple[float, ...], int] = {}

    def room(self, *numbers: float) -> int:
        """Return the first of new registers that are initialised with these numbers."""
        self._registers += numbers
        return len(self._registers) - len(numbers)

    def constant(self, *numbers: float) -> int:
        """Return the first of registers that no step sets."""
        if numbers not in self._constants:
            self._constants[numbers] = self.room(*numbers)
        return self._constants[numbers]

    def step(self, number: int, to: int, a: int, b: int, *numbers: float) -> int:
        """Add a step with its constants, and return the register that it sets."""
        self._steps.append((number, to, a, b, self.constant(*numbers)))
        return to

    def __str__(self) -> str:
        registers = [*self._registers, *[0.0] * WIDEST]
        registers[:2] = len(self.angles), len(registers)
        texts = [json.dumps(each)[1:-1] for each in (registers, *self._steps)]
        return "[\n  " + ",\n  ".join(texts) + "\n ]"


def _add_encoders(simulation: Simulation, program: _Program) -> None:
    """Add the steps from readings to joint angles, without weight."""
    joints = range(len(simulation.robot.joints))
    zeros = [0.0 for _ in joints]
    rows: Rows = {"ratios": [], "waves": [], "memories": []}
    for effect in simulation.all_effects:
        if effect.kind.is_zero:
            zeros[simulation.place(effect).joint] += float(effect.values[0])
        for name, added in (_rows(simulation, effect) or {}).items():
            rows.setdefault(name, []).extend(added)
    if simulation.bears_weight:
        for k in np.flatnonzero(simulation.springs):
            program.angles[k] = program.room(0.0)
    angles, q = program.angles, program.readings
    for k in joints:
        program.step(ADD, angles[k], program.constant(zeros[k]), q[k], 1.0)
    for joint, source, factor in rows["ratios"]:
        program.step(ADD, angles[joint], angles[joint], q[source], factor)
    for joint, *numbers in rows["waves"]:
        program.step(WAVE, angles[joint], angles[joint], q[joint], *numbers)
    for joint, kind, amount, scale in rows["memories"]:
        strain = program.step(MEMORY, program.room(0.0, 0.0, 0.0), q[joint], PACE, kind, scale)
        program.step(ADD, angles[joint], angles[joint], strain, -amount)


def _add_weights(simulation: Simulation, program: _Program) -> None:
    """Add the steps for the deflection of joints under gravity."""
    joints = range(len(simulation.robot.joints))
    springs = simulation.springs if simulation.bears_weight else np.zeros(len(joints))
    loose: dict[int, tuple[float, float, int]] = {}
    for effect in simulation.all_effects:
        for joint, half, hold in (_rows(simulation, effect) or {}).get("loose", []):
            loose[joint] = half, hold, program.room(0.0)
    weights = _Weights(simulation, program, {k for k in joints if springs[k] or k in loose})
    for _ in range(SimulationSettings.spring_rounds if springs.any() else 0):
        for k, torque in weights.torques():
            if springs[k]:
                program.angles[k] = program.step(ADD, ANGLES + k, weights.unloaded[k], torque, springs[k])
    for k, torque in weights.torques() if loose else ():
        if k in loose:
            half, hold, side = loose[k]
            program.step(SIDE, side, torque, side, hold)
            program.step(ADD, ANGLES + k, program.angles[k], side, half)


class _Weights:
    """Loads of compliant joints: the steps that compute gravity's torque about them.

    Args:
        gives: compliant joints. Others have bodies here only if they carry one of them, or are carried by one.

    Attributes:
        unloaded: register of each joint's angle before its deflection.
    """

    def __init__(self, simulation: Simulation, program: _Program, gives: set[int]) -> None:
        gravity, robot = simulation.gravity, simulation.robot
        self._program, self._gives, self.unloaded = program, gives, list(program.angles)
        self._parent = {k: gravity.bodies[k].carrier for k in gravity.outwards}
        bearers: dict[int | None, set[int]] = {None: set()}
        for k in gravity.outwards:
            bearers[k] = bearers[self._parent[k]] | {k}
        carrying = {k for joint in gives for k in bearers[joint]}
        fixed = [k for k in gravity.outwards if k in carrying and not bearers[k] & gives]
        self._moving = [k for k in gravity.outwards if k in carrying and bearers[k] & gives]
        carried = [k for k in gravity.outwards if k not in carrying and bearers[k] & gives]
        aligned: dict[int | None, FloatArray] = {None: np.eye(4)}
        aligned |= {k: _onto_z(robot.tree.joint(name).axis) for k, name in enumerate(robot.joints)}
        geometry, self._poses = geometry_without_zeros(simulation), dict[int, tuple[float, ...]]()
        for k in [*fixed, *self._moving, *carried]:
            joint, body = robot.tree.joint(robot.joints[k]), gravity.bodies[k]
            origin = geometry.T_parent_joint.get(joint.name, joint.T_parent_joint)
            on_carrier = body.T_carrier_joint @ inverse(joint.T_parent_joint) @ origin
            T = inverse(aligned[body.carrier]) @ on_carrier @ aligned[k]
            self._poses[k] = float(robot.chain.prismatic[k]), *_numbers(T)
        masses = [load.bodies for load in (gravity, *simulation.payloads)]
        self._carried_kg: dict[int | None, float] = dict.fromkeys([None, *self._parent], 0.0)
        self._loads: dict[int | None, int] = {}
        for k in reversed([*self._moving, *carried]):
            self._carried_kg[k] += float(sum(each[k].mass_kg for each in masses))
            self._carried_kg[self._parent[k]] += self._carried_kg[k]
            moment = aligned[k][:3, :3].T @ sum(each[k].moment for each in masses)
            self._loads[k] = program.constant(*moment.tolist(), self._carried_kg[k])
        self._down: dict[int | None, int] = {None: program.constant(0.0, 0.0, -GRAVITY_M_S2, 0.0)}
        self._sums: dict[int | None, int] = {}
        for k in fixed:
            self._turn_gravity(k)
        for k in reversed(carried):
            self._carry(k, self._loads)
        self._sums = {}

    def torques(self) -> Iterator[tuple[int, int]]:
        """Yield each compliant joint, from the farthest on, with the register of its torque at the present angles."""
        for k in self._moving:
            self._turn_gravity(k)
        loads, torque = dict(self._loads), self._program.room(0.0)
        for k in reversed(self._moving):
            if k in self._gives:
                self._program.step(TORQUE, torque, loads[k], self._down[k], self._poses[k][0])
            if self._parent[k] in loads:
                self._carry(k, loads)
            if k in self._gives:
                yield k, torque

    def _turn_gravity(self, k: int) -> None:
        """Add the step that rotates gravity from the frame of a body's carrier to its own."""
        if k not in self._down:
            self._down[k] = self._program.room(0.0, 0.0, 0.0, 0.0)
        self._program.step(
            OUTWARDS, self._down[k], self._down[self._parent[k]], self._program.angles[k], *self._poses[k]
        )

    def _carry(self, k: int, loads: dict[int | None, int]) -> None:
        """Add the steps that add the load of a body to that of its carrier."""
        at, moved = self._parent[k], self._program.room(0.0, 0.0, 0.0)
        self._program.step(INWARDS, moved, loads[k], self._program.angles[k], *self._poses[k])
        if at not in self._sums:
            self._sums[at] = self._program.room(0.0, 0.0, 0.0, self._carried_kg[at])
        loads[at] = self._program.step(ADD_THREE, self._sums[at], loads[at], moved, 1.0)


def _add_chain(simulation: Simulation, program: _Program) -> None:
    """Add the steps from the camera to the marker, joint by joint."""
    own, background = (
        [effect for effect in effects if not effect.kind.is_zero]
        for effects in (simulation.effects, simulation.background)
    )
    chain = simulation.with_effects(own).with_background(background).rigid_chain
    before, rows = np.eye(4), program.constant(*np.eye(4)[:3].ravel().tolist())
    for k, (fixed, axis, slides) in enumerate(zip(chain.fixed, chain.axes, chain.prismatic, strict=False)):
        onto_z = _onto_z(axis)
        T, to = before.T @ fixed @ onto_z, program.room(*[0.0] * 12)
        rows = program.step(OUTWARDS_THREE, to, rows, program.angles[k], float(slides), *_numbers(T))
        before = onto_z
    to_marker = before.T @ chain.fixed[-1]
    program.step(OUTWARDS_THREE, POSE, rows, program.constant(0.0), 0.0, *_numbers(to_marker))


def _onto_z(axis: FloatArray) -> FloatArray:
    """Return a rotation (4, 4) whose z is `axis`."""
    across = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(axis, x), axis], axis=1)
    return T


def _numbers(T: FloatArray) -> list[float]:
    return T[:3].ravel().tolist()
