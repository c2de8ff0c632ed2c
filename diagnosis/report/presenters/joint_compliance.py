"""Present a joint that deflects under the weight."""

from __future__ import annotations

from bodyschema.diagnosis.report.panels import Panel
from bodyschema.diagnosis.report.residuals import Residuals
from bodyschema.effects import Effect

from .evidence import load, over_quantity
from .presenter import DEG, FoundCause, Presenter, Workshop


class JointCompliance(Presenter):
    """Presenter of a joint that deflects under the weight."""

    effect = "joint_compliance"
    noun = "joint {joint} giving under the weight"

    def finding(self, found: FoundCause) -> str:
        numbers = found.numbers
        if not found.weighed:
            return f"{found.at} gives under the arm's weight"
        if "compliance_rad_per_Nm" in numbers:
            return f"{found.at} gives by {numbers['compliance_rad_per_Nm'] * DEG:.2g}°/N·m under the arm's weight"
        return f"{found.at} gives by {1e3 * numbers['compliance_m_per_N']:.2g} mm/N under the arm's weight"

    def remedy(self, workshop: Workshop, found: FoundCause) -> str:
        compliance = next(v for name, v in found.numbers.items() if name.startswith("compliance"))
        most = workshop.torques[workshop.joint(found)] * compliance
        sag = f"{1e3 * most:.2g} mm" if workshop.slides(found) else f"{most * DEG:.2g}°"
        about = "up to" if found.weighed else "roughly up to, since the URDF states no masses,"
        return (
            f"Check what bears the weight at {found.where}: screws, gear, belt, the gain of its position loop ({about} "
            f"{sag} here). A spring that stays belongs into the simulation, as in extended.toml."
        )

    def panel(self, residuals: Residuals, effect: Effect) -> Panel:
        torque, label = load(residuals, effect)
        return over_quantity(residuals, effect, torque, label, effect.values[0] * torque)
