"""Torque constants of Dynamixel models.

Sources: ROBOTIS e-Manual, "Specifications" of each model (github.com/ROBOTIS-GIT/emanual: _data/dxl_x_info.yml, and
_includes/common/compatible_dxl/compatible_x540.md for XD540): for the X and MX series stall torque and stall current at
the recommended voltage, for the P series continuous torque and continuous current. XW540-H260 is made to order and has
no published figures: its user gives the constant. Because of friction a real servo gives some tenths less at small
currents.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

# By model: torque [N·m] and the corresponding current [A].
TORQUE_AT_CURRENT: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "MX-64(2.0)": (6.0, 4.1),
        "MX-106(2.0)": (8.4, 5.2),
        "XL330-M077": (0.215, 1.47),
        "XL330-M288": (0.52, 1.47),
        "XC330-M181": (0.60, 1.80),
        "XC330-M288": (0.93, 1.80),
        "XC330-T181": (0.76, 0.80),
        "XC330-T288": (0.92, 0.80),
        "XM430-W210": (3.0, 2.3),
        "XM430-W350": (4.1, 2.3),
        "XH430-W210": (2.5, 1.3),
        "XH430-W350": (3.4, 1.3),
        "XH430-V210": (2.6, 0.7),
        "XH430-V350": (3.3, 0.7),
        "XD430-T210": (2.5, 1.3),
        "XD430-T350": (3.4, 1.3),
        "XW430-T333": (3.1, 1.3),
        "XM540-W150": (7.3, 4.4),
        "XM540-W270": (10.6, 4.4),
        "XH540-W150": (7.1, 4.9),
        "XH540-W270": (9.9, 4.9),
        "XH540-V150": (6.4, 2.4),
        "XH540-V270": (9.2, 2.4),
        "XD540-T150": (7.1, 4.9),
        "XD540-T270": (9.9, 4.9),
        "XW540-T140": (6.9, 4.9),
        "XW540-T260": (9.5, 4.9),
        "PH42-020-S300": (5.1, 1.5),
        "PH54-100-S500": (25.3, 5.5),
        "PH54-200-S500": (44.7, 9.3),
        "PM42-010-S260": (1.7, 0.6),
        "PM54-040-S250": (3.9, 1.9),
        "PM54-060-S250": (10.1, 3.0),
    }
)


def torque_constant(model: str) -> float | None:
    """Return the torque per current of a model [N·m/A]; None if its manual's figures are not listed."""
    if model not in TORQUE_AT_CURRENT:
        return None
    torque, current = TORQUE_AT_CURRENT[model]
    return torque / current
