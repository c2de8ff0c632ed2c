"""Replay an exported file: the marker's position at each reading, by MuJoCo or by the reader of correction.json."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.effects.motion import Motion
from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray

from .mjcf import LOOSE, MARKER, MEASUREMENT

_SPRING_ROUNDS = 5  # a spring's deflection changes its own load; each round adds the next order


def mujoco_version() -> str | None:
    """Return the version of the installed MuJoCo; None without it."""
    try:
        import mujoco
    except ImportError:
        return None
    return str(mujoco.__version__)


def replayed(file: Path, joints: Sequence[str], motion: Motion) -> FloatArray:
    """Return positions (n, 3) [m] of the marker in the measurement frame, from an MJCF file alone.

    At each row the arm is at rest: constraints are met, springs balance gravity, and a joint with backlash is dragged
    along by the rest of its joint.

    Raises:
        ConfigError: MuJoCo is not installed, or cannot load the file.
    """
    import mujoco

    try:
        statics = _Statics(mujoco, file, joints)
    except ValueError as error:
        raise ConfigError(f"MuJoCo does not load it: {error}", file=file) from error
    return statics.positions(motion.q)


def corrected(file: Path, motion: Motion) -> FloatArray:
    """Return positions (n, 3) [m] of the marker in the measurement frame, from a correction.json alone.

    They are those of examples/correction/correction.py, the reader that controllers copy.
    """
    here = Path(__file__).resolve()
    wheel, checkout = here.with_name("correction_reader.py"), here.parents[2] / "examples/correction/correction.py"
    spec = spec_from_file_location("bodyschema_correction_reader", wheel if wheel.exists() else checkout)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    reader = module.Correction(file.read_text(encoding="utf-8"))
    paces = [None if begins else pace for begins, pace in zip(motion.begins, motion.pace.tolist(), strict=True)]
    return np.array([reader.read(q, pace)[1][3::4] for q, pace in zip(motion.q.tolist(), paces, strict=True)])


class _Statics:
    """A MuJoCo model at rest."""

    def __init__(self, mujoco: Any, file: Path, joints: Sequence[str]) -> None:
        self._mujoco = mujoco
        self._model = mujoco.MjModel.from_xml_path(str(file))
        self._data = mujoco.MjData(self._model)
        model, types = self._model, mujoco.mjtEq
        self._read = np.array([model.joint(name).qposadr[0] for name in joints])
        tied = [(k, model.eq_obj1id[k], model.eq_obj2id[k]) for k in range(model.neq)]
        self._ties = [
            (model.jnt_qposadr[a], model.jnt_qposadr[b], model.eq_data[k, :5])
            for k, a, b in tied
            if model.eq_type[k] == types.mjEQ_JOINT
        ]
        # The first joint of a tied tendon is the one that holds the errors.
        self._errors = [
            (model.jnt_qposadr[model.wrap_objid[model.tendon_adr[a]]], a, b, model.eq_data[k, :5])
            for k, a, b in tied
            if model.eq_type[k] == types.mjEQ_TENDON
        ]
        # The joints of a tendon with friction: the read one, and the loose one.
        self._plays = [
            tuple(model.wrap_objid[model.tendon_adr[k] + i] for i in range(2))
            for k in range(model.ntendon)
            if model.tendon_frictionloss[k] > 0.0
        ]
        self._springs = np.flatnonzero(model.jnt_stiffness > 0.0)
        self._loose = [k for k in range(model.njnt) if model.joint(k).name.endswith(LOOSE)]

    def positions(self, readings: FloatArray) -> FloatArray:
        """Return positions at readings (n, d), in their order."""
        mujoco, model, data = self._mujoco, self._model, self._data
        qpos, springs = data.qpos, model.jnt_qposadr[self._springs]
        loads, stiffness = model.jnt_dofadr[self._springs], model.jnt_stiffness[self._springs]
        outputs = [self._first_output(read, loose, readings) for read, loose in self._plays]
        found, sides = np.empty((len(readings), 3)), dict.fromkeys(self._loose, 0.0)
        for row, reading in enumerate(readings):
            qpos[self._read], qpos[model.jnt_qposadr[self._loose]] = reading, 0.0
            for y, x, polynomial in self._ties:
                qpos[y] = model.qpos0[y] + _polynomial(polynomial, qpos[x] - model.qpos0[x])
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            for y, tied, by, polynomial in self._errors:
                longer = data.ten_length[by] - model.tendon_length0[by] if by >= 0 else 0.0
                qpos[y] += model.tendon_length0[tied] + _polynomial(polynomial, longer) - data.ten_length[tied]
            for k, (read, loose) in enumerate(self._plays):
                input_ = qpos[model.jnt_qposadr[read]]
                outputs[k] = input_ + np.clip(outputs[k] - input_, *model.jnt_range[loose])
                qpos[model.jnt_qposadr[loose]] = outputs[k] - input_
            for _ in range(_SPRING_ROUNDS if len(springs) else 0):
                mujoco.mj_forward(model, data)
                qpos[springs] = -data.qfrc_bias[loads] / stiffness
            if self._loose:
                mujoco.mj_forward(model, data)
            for k in self._loose:
                torque = -float(data.qfrc_bias[model.jnt_dofadr[k]])
                if not sides[k] or abs(torque) > model.dof_frictionloss[model.jnt_dofadr[k]]:
                    sides[k] = -1.0 if torque < 0.0 else 1.0
                qpos[model.jnt_qposadr[k]] = sides[k] * model.jnt_range[k, 1]
            mujoco.mj_kinematics(model, data)
            seen = data.site(MEASUREMENT)
            found[row] = (data.site(MARKER).xpos - seen.xpos) @ seen.xmat.reshape(3, 3)
        return found

    def _first_output(self, read: int, loose: int, readings: FloatArray) -> float:
        """Return the initial output of a backlash: on the side to which the first move leads."""
        model = self._model
        column = readings[:, int(np.flatnonzero(self._read == model.jnt_qposadr[read])[0])]
        moves = np.diff(column)
        leading = moves[np.flatnonzero(moves)[:1]]
        lower, upper = model.jnt_range[loose]
        return float(column[0]) + (0.0 if not len(leading) else float(lower if leading[0] > 0.0 else upper))


def _polynomial(coefficients: FloatArray, x: float) -> float:
    """Evaluate a polynomial with the constant first, as in MuJoCo's equalities."""
    value = 0.0
    for coefficient in coefficients[::-1]:
        value = value * x + coefficient
    return float(value)
