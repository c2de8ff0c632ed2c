"""Name of a hidden effect in the table of effects, and the numbers with which it should be found.

The hider speaks of its own mechanisms, with signs of its own; here they become those of `effects`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from bodyschema.effects import Effect
from bodyschema.robot.description import RobotDescription

from .hidden import Hidden, Parameters
from .kinds import SHIFT, SIX

Key = tuple[str, str | None, str | None]


@dataclass(frozen=True, eq=False)
class Meant:
    """A hidden effect as an effect of the table.

    Attributes:
        effect: with its numbers, to first order in the hidden ones.
        told: names of the numbers that follow from its mechanism; the others are approximate.
    """

    effect: Effect
    told: frozenset[str]

    @property
    def key(self) -> Key:
        """Identity of the effect, independent of its numbers."""
        return self.effect.key


def meant(hidden: Hidden, robot: RobotDescription, usual_s: float) -> Meant | None:
    """Return the hidden effect in the terms of the table; None if no row of the table describes it.

    Args:
        usual_s: median time between two pairs of a run [s].
    """
    if hidden.outside or hidden.effect == "outliers":
        return None
    name, values = _named(hidden, usual_s)
    effect = Effect.at(robot, name, hidden.where, hidden.source, {k: v for k, v in values.items() if not math.isnan(v)})
    return Meant(effect, frozenset(name for name, value in values.items() if not math.isnan(value)))


def _named(hidden: Hidden, usual_s: float) -> tuple[str, Parameters]:
    """Return name and numbers; NaN for a number that the mechanism does not have."""
    p, name = hidden.parameters, hidden.effect
    unit = "m" if any(key in p for key in ("turn_m", "offset_m", "jump_m", "play_m")) else "rad"
    match name:
        case "joint_offset":
            return name, {f"offset_{unit}": -p[f"offset_{unit}"]}
        case "joint_scale" | "camera_scale":
            return name, {"scale_error": 1.0 / (1.0 + p["scale"]) - 1.0}
        case "joint_eccentricity" | "joint_ripple":
            return _periodic(name, p)
        case "encoder_jump":
            return name, {f"jump_{unit}": -p[f"jump_{unit}"], "t0": p["t0_s"]}
        case "backlash":
            return name, {f"width_{unit}": p[f"play_{unit}"]}
        case "settling":
            return name, _settling(p, usual_s)
        case "tool_offset" | "tool_slip":
            return name, _shifts(p) | _moment(p)
        case "camera_pose" | "camera_moved" | "link_geometry":
            return name, _shifts(p) | {key: p[key] for key in SIX[3:]} | _moment(p)
        case "camera_focal":
            return name, {"focal_error": p["scale"]}
        case "lens_distortion":
            return name, {"k1": p["k1"], "k2": p["k2"]}
        case "thermal_drift":
            return name, _shifts(p) | {"time_constant_s": p["tau_s"]}
        case _:  # coupling, compliance, latency: the same quantity under the same name
            return name, dict(p)


def _periodic(name: str, p: Parameters) -> tuple[str, Parameters]:
    """Return the correction (a sin Nq - b cos Nq) / N of a reading that is off by (b cos Nq - a sin Nq) / N."""
    poles = p.get("poles", 1.0)
    a, b = (p["ex"], p["ey"]) if name == "joint_eccentricity" else (p["bias_cosine"], p["bias_sine"])
    if "turn_m" in p:  # on a slide, once per turn of the ring is a ripple over its length
        arm = p["turn_m"] / (2.0 * math.pi * poles)
        return "joint_ripple", {"sine_m": arm * a, "cosine_m": -arm * b, "cycles_per_m": poles / p["turn_m"]}
    numbers = {"sine_rad": a / poles, "cosine_rad": -b / poles}
    return name, numbers if name == "joint_eccentricity" else numbers | {"cycles_per_turn": poles}


def _settling(p: Parameters, usual_s: float) -> Parameters:
    """Return the fractions left after a move and after the usual time; NaN on a walk without rests."""
    if "left" not in p:
        return {"fraction": math.nan, "memory": math.nan}
    return {"fraction": p["left"], "memory": math.exp(-usual_s / p["tau_s"])}


def _shifts(p: Parameters) -> Parameters:
    return {key.removeprefix("d"): p[key] for key in SHIFT}


def _moment(p: Parameters) -> Parameters:
    return {"t0": p["t0_s"]} if "t0_s" in p else {}
