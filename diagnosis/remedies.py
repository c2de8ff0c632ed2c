"""Advise what to do about each cause, with numbers: ticks to write, lines of robot.toml and URDF, screws to tighten."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from bodyschema.effects import EFFECT_TYPES, corrected_file
from bodyschema.effects.poses import transforms
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.rpy import rpy_of

from .numbers import named, rival_named
from .result import Cause, DiagnosisFile

_DEG = math.degrees(1.0)
# Ticks that divide a turn to within this share are counted per turn.
_WHOLE_TURN = 0.01
# Remaining share at which a drift is over, and at which a move has ended.
_OVER, _ENDED = 0.05, 0.001
_TURN_ORIGIN = "turn the origin of joint {} by as much about"
# A scale error below this reverses the joint's direction.
_BACKWARDS = -1.0
# A less probable cause is to be confirmed first.
_SURE = 0.9


def remedies(
    diagnosis: DiagnosisFile, robot: RobotDescription, steps: FloatArray, torques: FloatArray | None
) -> list[str]:
    """Return advice on each cause, the one that explains most first.

    Args:
        steps: encoder step of each joint (d,) [rad, m]; 0 where it is unknown.
        torques: the largest torque of gravity on each joint (d,) [N·m, N]; None where masses are unknown.
    """
    workshop = _Workshop(robot, steps, torques, {cause.effect: cause for cause in diagnosis.causes})
    causes = sorted(diagnosis.causes, key=lambda cause: -cause.share_of_gain_percent)
    return [_if_sure(cause, workshop.remedy(cause)) for cause in causes]


def _if_sure(cause: Cause, remedy: str) -> str:
    """Return the remedy, preceded by what to confirm before any change."""
    open_ones = [rival for rival in cause.rivals if rival.by == "this_motion"]
    if cause.probability >= _SURE or not open_ones:
        return remedy
    rivals = " or ".join(rival_named(rival) for rival in open_ones[:2])
    return (
        f"If it is {named(cause.effect, cause.where, cause.source)} and not {rivals}: {remedy[0].lower()}{remedy[1:]}"
    )


@dataclass(frozen=True)
class _Workshop:
    robot: RobotDescription
    steps: FloatArray
    torques: FloatArray | None
    causes: Mapping[str, Cause] = field(default_factory=dict)

    def remedy(self, cause: Cause) -> str:
        numbers = {name: interval.value for name, interval in cause.parameters.items()}
        return _BY_EFFECT.get(cause.effect, _Workshop.of_a_plugin)(self, cause, numbers)

    def offset(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        move = "move the origin of joint {} by as much along" if self._slides(cause) else _TURN_ORIGIN
        return (
            f"Add {self._turn(cause, numbers, 'offset')} to what the encoder of {cause.where} reads, in its homing "
            f"offset or in the driver. Or in the URDF: {move.format(cause.where)} its axis{self._in_urdf()}."
        )

    def scale(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        if numbers["scale_error"] < _BACKWARDS:
            return f"Give the readings of {cause.where} the other sign, in driver and recordings, and diagnose again."
        return (
            f"Multiply what the encoder of {cause.where} reads by {1.0 + numbers['scale_error']:.5f}: check its gear "
            "ratio and its counts per turn."
        )

    def eccentricity(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        return (
            f"Centre the encoder's magnet of {cause.where} on the axis. Until then add "
            f"{numbers['amplitude_rad'] * _DEG:.3g}°·sin(q {_signed(numbers['phase_rad'] * _DEG)}°) to its reading q."
        )

    def ripple(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        phase = f"{_signed(numbers['phase_rad'] * _DEG)}°"
        if self._slides(cause):
            cycles = numbers["cycles_per_m"]
            wave = f"{1e3 * numbers['amplitude_m']:.2g} mm·sin(360°·{cycles:.4g}/m·q {phase})"
            part = f"has a pitch of {1e3 / cycles:.3g} mm"
        else:
            cycles = numbers["cycles_per_turn"]
            wave = f"{numbers['amplitude_rad'] * _DEG:.2g}°·sin({cycles:.4g}·q {phase})"
            part = f"comes round {cycles:.3g} times a turn: teeth, a strain wave, pole pairs"
        return f"Look in the drive of {cause.where} for what {part}. Or add {wave} to its reading q."

    def coupling(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        return (
            f"In the driver, add {numbers['ratio']:+.5f} times the reading of {cause.source} to that of {cause.where}: "
            f"a tendon or a differential carries {cause.source}'s motion on."
        )

    def jump(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        return (
            f"Look for what slipped at {cause.where} (the horn's screw, a coupling, lost counts), tighten it, and home "
            f"the joint again. Readings from the jump on need {self._turn(cause, numbers, 'jump')} more."
        )

    def backlash(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        play = self._turn(cause, numbers, "width").replace("+", "")
        return (
            f"Tighten or preload the gear of {cause.where}. Until then come to each pose from the same side, by more "
            f"than {play}."
        )

    def settling(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        fraction = numbers["fraction"]
        longer = math.log(_ENDED) / math.log(fraction) if 0.0 < fraction < 1.0 else 2.0
        wait = f"{longer:.2g} times as long" if longer > 1.0 else "longer"
        return (
            f"Wait {wait} before {cause.where} is read, which leaves {100 * _ENDED:g} % of a move; or raise the gain "
            "of its controller."
        )

    def compliance(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        k = self.robot.joints.index(cause.where or "")
        sag = ""
        if self.torques is not None:
            most = self.torques[k] * next(v for name, v in numbers.items() if name.startswith("compliance"))
            sag = f" (up to {1e3 * most:.2g} mm here)" if self._slides(cause) else f" (up to {most * _DEG:.2g}° here)"
        return (
            f"Check what bears the weight at {cause.where}: screws, gear, belt, the gain of its position loop{sag}. A "
            "spring that stays belongs into the simulation, as in extended.toml."
        )

    def hysteresis(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        way = self._turn(cause, numbers, "length").replace("+", "")
        return (
            f"Look for friction behind the drive of {cause.where}: bearing, seal, cable, brake. Until then come to "
            f"each pose from the same side, by several times {way}."
        )

    def gravity_backlash(self, cause: Cause, numbers: Mapping[str, float]) -> str:
        play = self._turn(cause, numbers, "width").replace("+", "")
        return (
            f"Tighten or preload the gear of {cause.where}, or load it by a spring so that it stays on one flank. "
            f"Poses in which the weight pulls the other way differ by {play}, from whichever side they are reached."
        )

    def payload(self, _: Cause, numbers: Mapping[str, float]) -> str:
        mass = numbers["mass_kg"]
        centre = [numbers[f"{axis}_kgm"] / max(mass, 1e-9) for axis in "xyz"]
        return (
            f"Weigh what the hand carries and give the link {self.robot.robot.marker_link} of the URDF an inertial "
            f"with its mass: {mass:.2g} kg here, with its centre at {_list(np.round(centre, 3))} m. Or take it off."
        )

    def link(self, cause: Cause, _: Mapping[str, float]) -> str:
        origin = self.robot.tree.joint(cause.where or "").T_parent_joint @ self._pose(cause)
        return f"In the URDF, give joint {cause.where} the {_origin(origin)}{self._in_urdf()}."

    def tool(self, _: Cause, numbers: Mapping[str, float]) -> str:
        return f"In robot.toml: marker_xyz = {self._marker(numbers)}, or put the marker back to where it was."

    def slip(self, _: Cause, numbers: Mapping[str, float]) -> str:
        line = f" What was measured since needs marker_xyz = {self._marker(numbers)}." if self._marker_is_told() else ""
        return f"Fasten the marker: it slipped on the hand.{line}"

    def camera(self, cause: Cause, _: Mapping[str, float]) -> str:
        return f"In [camera] of robot.toml: {_toml_pose(self.robot.camera.pose @ self._pose(cause))}."

    def bumped(self, cause: Cause, _: Mapping[str, float]) -> str:
        seen_by = "instrument" if self.robot.calibration is None else "camera"
        advice = f"Fasten the {seen_by}, and the arm's foot: one of them moved."
        if not self.robot.camera.pose_known:
            return f"{advice} Calibrate its pose again with what was measured since."
        start = self.robot.camera.pose
        if (known := self.causes.get("camera_pose")) is not None:
            start = start @ self._pose(known)
        return f"{advice} Since then its pose in robot.toml is {_toml_pose(start @ self._pose(cause))}."

    def baseline(self, _: Cause, numbers: Mapping[str, float]) -> str:
        factor = 1.0 + numbers["scale_error"]
        if self.robot.calibration is None:
            return (
                f"Divide what is measured by {factor:.5f}: the instrument's scale is off, or all links of the URDF are."
            )
        if not self.robot.calibration.is_stereo:
            return (
                f"Measure the marker again: its side_m (or radius_m) in robot.toml seems to be {factor:.5f} times what "
                "it is."
            )
        return (
            f"Calibrate the stereo pair again; or set baseline_m = {self.robot.calibration.baseline_m / factor:.6g} in "
            "robot.toml."
        )

    def focal(self, _: Cause, numbers: Mapping[str, float]) -> str:
        assert self.robot.calibration is not None
        focal = self.robot.calibration.focal_px * (1.0 + numbers["focal_error"])
        return f"Calibrate the cameras again; or set focal_px = {focal:.6g} in robot.toml."

    def lens(self, _: Cause, numbers: Mapping[str, float]) -> str:
        return f"Calibrate the lenses again: the images that are called rectified have k1 = {numbers['k1']:+.3g} left."

    def latency(self, _: Cause, numbers: Mapping[str, float]) -> str:
        late = numbers["latency_s"]
        what = "Subtract" if late > 0.0 else "Add"
        where = "from" if late > 0.0 else "to"
        return f"{what} {1e3 * abs(late):.3g} ms {where} the images' time stamps, or stop the arm for each pair."

    def drift(self, _: Cause, numbers: Mapping[str, float]) -> str:
        wait = -math.log(_OVER) * numbers["time_constant_s"]
        return (
            f"Let camera and arm warm up for {_duration(wait)} before recording: {100 * _OVER:.0f} % of the drift is "
            "left then."
        )

    def of_a_plugin(self, cause: Cause, _: Mapping[str, float]) -> str:
        return EFFECT_TYPES[cause.effect].remedy(f"joint {cause.where}")

    def outliers(self, _: Cause, numbers: Mapping[str, float]) -> str:
        return (
            f"Look at the images of the {100 * numbers['share']:.2g} % of fixes that are not the marker: cover what "
            "else looks like it, and keep people out of the view. They were left out here."
        )

    def _turn(self, cause: Cause, numbers: Mapping[str, float], base: str) -> str:
        if self._slides(cause):
            return f"{1e3 * numbers[f'{base}_m']:+.3g} mm{self._ticks(cause, numbers[f'{base}_m'])}"
        return f"{numbers[f'{base}_rad'] * _DEG:+.3g}°{self._ticks(cause, numbers[f'{base}_rad'])}"

    def _ticks(self, cause: Cause, amount: float) -> str:
        k = self.robot.joints.index(cause.where or "")
        step = float(self.steps[k])
        if step <= 0.0:
            return ""
        count = round(amount / step)
        per_turn = 2.0 * math.pi / step
        of = ""
        if not self._slides(cause) and abs(per_turn - round(per_turn)) < _WHOLE_TURN * per_turn:
            of = f" of {round(per_turn)} a turn"
        return f" ({count:+d} tick{'' if abs(count) == 1 else 's'}{of})"

    def _in_urdf(self) -> str:
        return f" (--out writes {corrected_file(self.robot)}, which has it)"

    def _slides(self, cause: Cause) -> bool:
        return bool(self.robot.chain.prismatic[self.robot.joints.index(cause.where or "")])

    def _marker_is_told(self) -> bool:
        return self.robot.robot.marker_known

    def _marker(self, numbers: Mapping[str, float]) -> str:
        shift = np.array([numbers[f"{axis}_m"] for axis in "xyz"])
        if (known := self.causes.get("tool_offset")) is not None and "t0" in numbers:
            shift = shift + np.array([known.parameters[f"{axis}_m"].value for axis in "xyz"])
        return _list(np.array(self.robot.robot.marker_xyz) + shift)

    @staticmethod
    def _pose(cause: Cause) -> FloatArray:
        names = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
        told = {name: interval.value for name, interval in cause.parameters.items()}
        return transforms(np.array([[told.get(name, 0.0) for name in names]]))[0]


_BY_EFFECT: dict[str, Callable[[_Workshop, Cause, Mapping[str, float]], str]] = {
    "joint_offset": _Workshop.offset,
    "joint_scale": _Workshop.scale,
    "joint_eccentricity": _Workshop.eccentricity,
    "joint_ripple": _Workshop.ripple,
    "joint_coupling": _Workshop.coupling,
    "encoder_jump": _Workshop.jump,
    "backlash": _Workshop.backlash,
    "settling": _Workshop.settling,
    "hysteresis": _Workshop.hysteresis,
    "joint_compliance": _Workshop.compliance,
    "gravity_backlash": _Workshop.gravity_backlash,
    "payload": _Workshop.payload,
    "link_geometry": _Workshop.link,
    "tool_offset": _Workshop.tool,
    "tool_slip": _Workshop.slip,
    "camera_pose": _Workshop.camera,
    "camera_moved": _Workshop.bumped,
    "camera_scale": _Workshop.baseline,
    "camera_focal": _Workshop.focal,
    "lens_distortion": _Workshop.lens,
    "camera_latency": _Workshop.latency,
    "thermal_drift": _Workshop.drift,
    "outliers": _Workshop.outliers,
}


def _signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'} {abs(value):.3g}"


def _list(values: FloatArray) -> str:
    return f"[{', '.join(_short(value, 5) for value in values.tolist())}]"


def _short(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}".rstrip("0").rstrip(".")


def _origin(pose: FloatArray) -> str:
    xyz, rpy = (" ".join(_short(v, 6) for v in part.tolist()) for part in (pose[:3, 3], rpy_of(pose[:3, :3])))
    return f'origin xyz="{xyz}" rpy="{rpy}"'


def _toml_pose(pose: FloatArray) -> str:
    return f"xyz = {_list(pose[:3, 3])}, rpy = {_list(rpy_of(pose[:3, :3]))}"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
