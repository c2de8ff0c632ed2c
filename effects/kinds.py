"""Define the table of effects: each way in which reality may differ from the simulation, once."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

from bodyschema.robot.plugins import installed

from .encoder import ENCODER_EFFECTS, EncoderEffect
from .parameter import Parameter

Stage = Literal["encoder", "structure", "tool", "camera", "time"]


@dataclass(frozen=True, slots=True)
class Kind:
    """One row of the table.

    Attributes:
        name: as in `diagnosis.json`.
        stage: the stage of the simulation at which it acts.
        at_joint: True if it acts at a joint.
        turning, sliding: its parameters at a revolute or prismatic joint; equal where it acts at no joint.
        encoder: its encoder error, for effects of the first stage.
        begins: True if it begins at a moment, its parameter `t0`.
        needs_times: True if it needs times, not only an order.
        needs_stereo: True if it needs the stereo calibration.
        needs_weight: True if it needs joints that bear the arm's weight, and its masses.
    """

    name: str
    stage: Stage
    at_joint: bool
    turning: tuple[Parameter, ...]
    sliding: tuple[Parameter, ...]
    encoder: EncoderEffect | None = None
    begins: bool = False
    needs_times: bool = False
    needs_stereo: bool = False
    needs_weight: bool = False

    def parameters(self, prismatic: bool) -> tuple[Parameter, ...]:
        """Return its parameters at a revolute or prismatic joint."""
        return self.sliding if prismatic else self.turning

    @property
    def takes_source(self) -> bool:
        """True if another joint causes it."""
        return self.encoder is not None and self.encoder.takes_source

    @property
    def turns_only(self) -> bool:
        """True if only a revolute joint can have it."""
        return self.encoder is not None and self.encoder.turns_only


T0 = Parameter("t0", 0.0, None)
TIME_CONSTANT = Parameter("time_constant_s", 600.0, None, smooth=True)
_SHIFT = tuple(Parameter(f"{axis}_m", 0.01) for axis in "xyz")
_TURN = tuple(Parameter(f"r{axis}_rad", 0.02) for axis in "xyz")
_PAYLOAD = (Parameter("mass_kg", 1.0, never_negative=True), *(Parameter(f"{axis}_kgm", 0.05) for axis in "xyz"))
_LINK = (*(Parameter(f"{axis}_m", 0.005) for axis in "xyz"), *_TURN)


def _free(
    name: str, stage: Stage, *parameters: Parameter, needs_times: bool = False, needs_stereo: bool = False
) -> Kind:
    begins = T0 in parameters
    return Kind(name, stage, False, parameters, parameters, None, begins, needs_times, needs_stereo)


def _of_encoder(effect: EncoderEffect) -> Kind:
    turning = effect.parameters(False)
    return Kind(
        effect.name, "encoder", True, turning, effect.parameters(True), effect, any(p.name == "t0" for p in turning)
    )


def _of_plugins() -> list[EncoderEffect]:
    """Return the effects of other packages that load; built-in names take precedence."""
    names = {effect.name for effect in ENCODER_EFFECTS}
    found: list[EncoderEffect] = []
    for entry in installed("bodyschema.effects"):
        try:
            effect = entry.load()()
        except Exception as error:
            warnings.warn(f"the effect {entry.value} of another package is left out: {error}", stacklevel=2)
            continue
        if effect.name not in names:
            found.append(effect)
            names.add(effect.name)
    return found


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        *(_of_encoder(effect) for effect in (*ENCODER_EFFECTS, *_of_plugins())),
        Kind(
            "joint_compliance",
            "structure",
            True,
            (Parameter("compliance_rad_per_Nm", 0.001, never_negative=True),),
            (Parameter("compliance_m_per_N", 1e-5, never_negative=True),),
            needs_weight=True,
        ),
        Kind(
            "gravity_backlash",
            "structure",
            True,
            (Parameter("width_rad", 0.01, never_negative=True), Parameter("hold_Nm", 0.0, None)),
            (Parameter("width_m", 0.002, never_negative=True), Parameter("hold_N", 0.0, None)),
            needs_weight=True,
        ),
        Kind("payload", "structure", False, _PAYLOAD, _PAYLOAD, needs_weight=True),
        Kind("link_geometry", "structure", True, _LINK, _LINK),
        _free("tool_offset", "tool", *_SHIFT),
        _free("tool_slip", "tool", *_SHIFT, T0),
        _free("camera_pose", "camera", *_SHIFT, *_TURN),
        _free("camera_moved", "camera", *_SHIFT, *_TURN, T0),
        _free("camera_scale", "camera", Parameter("scale_error", 0.01)),
        _free("camera_focal", "camera", Parameter("focal_error", 0.01), needs_stereo=True),
        _free("lens_distortion", "camera", Parameter("k1", 0.02), Parameter("k2", 0.02), needs_stereo=True),
        _free("camera_latency", "time", Parameter("latency_s", 0.02), needs_times=True),
        _free("thermal_drift", "time", *_SHIFT, TIME_CONSTANT, needs_times=True),
    )
}
