"""Control table contents of a new Dynamixel servo.

Source: ROBOTIS e-Manual, "Control Table of EEPROM Area" and "... of RAM Area" of AX-12A, MX-12W, MX-28, MX-28(2.0),
MX-64(2.0), XL330-M077 and -M288, XC330-M288 and -T288, XL430-W250, XM430-W210 and -W350, XM540-W270, PH42-020-S300 and
PH54-200-S500. Other models have the values of the most similar of these.
"""

from __future__ import annotations

from dataclasses import dataclass

from bodyschema.drivers.dynamixel.models import LAYOUT_P, Model

Values = tuple[tuple[int, int, int], ...]
"""Address, bytes, number."""


@dataclass(frozen=True, slots=True)
class Factory2:
    """Register values of Protocol 2.0; those of the X430 by default."""

    threshold: int = 10
    temperature: int = 80
    voltages: tuple[int, int] = (95, 160)
    pwm: int = 885
    current: int = 1193
    acceleration: int = 0
    velocity: int = 200
    positions: tuple[int, int] | None = (0, 4095)  # limits [ticks]; None: a turn around the middle
    ports: int = 0  # number of external ports
    slope: int = 0
    shutdown: int = 52
    # I and P of the velocity, D, I and P of the position
    gains: tuple[int, int, int, int, int] = (1920, 100, 0, 0, 800)
    supply: int = 120  # rated supply voltage [0.1 V]

    def values(self, model: Model) -> Values:
        """Return address, size and value of all registers."""
        half = (model.ticks_per_turn or 0) // 2
        lowest, highest = self.positions or (model.zero_ticks - half, model.zero_ticks + half)
        first_gain = model.layout["torque"].address + 12
        return (
            (12, 1, 255),  # Secondary ID: none
            (13, 1, 2),  # protocol
            (24, 4, self.threshold),
            (31, 1, self.temperature),
            (32, 2, self.voltages[1]),
            (34, 2, self.voltages[0]),
            (36, 2, self.pwm),
            (38, 2, self.current),
            (40, 4, self.acceleration),
            (44, 4, self.velocity),
            (48, 4, highest),
            (52, 4, lowest),
            *((56 + k, 1, 3) for k in range(self.ports)),
            (62, 1, self.slope),
            (63, 1, self.shutdown),
            *((first_gain + 2 * k, 2, gain) for k, gain in enumerate(self.gains)),
            (model.layout["voltage"].address, 2, self.supply),
        )


_P = {"threshold": 20, "voltages": (150, 350), "pwm": 2009, "ports": 4, "supply": 240}
_FIVE_VOLTS = {"temperature": 70, "voltages": (35, 70), "slope": 140, "supply": 50}
# The first entry that a model's name starts with applies.
FACTORY2 = {
    "XM430-W210": Factory2(velocity=330),
    "XM540": Factory2(current=2047, velocity=128, ports=3),
    "XL330-M077": Factory2(**_FIVE_VOLTS, current=1750, velocity=1620, shutdown=53, gains=(400, 40, 0, 400, 400)),
    "XL330": Factory2(**_FIVE_VOLTS, current=1750, velocity=445, shutdown=53, gains=(1600, 180, 0, 0, 400)),
    "XC330-M": Factory2(**_FIVE_VOLTS, current=2352, velocity=350, gains=(1600, 50, 500, 0, 1100)),
    "XC330-T": Factory2(
        temperature=70, voltages=(55, 140), current=910, velocity=320, slope=255, gains=(1200, 40, 0, 0, 900)
    ),
    **dict.fromkeys(
        ("XL430", "XC430", "2X"),
        Factory2(temperature=72, voltages=(60, 140), current=0, velocity=265, gains=(1000, 100, 4000, 0, 640)),
    ),
    "X": Factory2(),
    "MX-28": Factory2(current=0, acceleration=32_767, velocity=380, gains=(1920, 100, 0, 0, 850)),
    "MX": Factory2(current=1941, acceleration=32_767, velocity=435, gains=(1920, 100, 0, 0, 850)),
    "PH42": Factory2(
        **_P,
        current=4500,
        acceleration=10_765,
        velocity=2920,
        positions=(-303_454, 303_454),
        shutdown=58,
        gains=(0, 0, 0, 0, 0),  # not documented
    ),
    "PH54": Factory2(
        **_P,
        current=22_740,
        acceleration=3_992_644,
        velocity=2900,
        positions=(-501_433, 501_433),
        gains=(2209, 6153, 0, 0, 314),
    ),
    "P": Factory2(**_P, current=22_740, velocity=2900, positions=None),
}

_ALL1: Values = ((6, 2, 0), (12, 1, 60), (14, 2, 1023), (17, 1, 36), (34, 2, 1023), (42, 1, 120))
_MX1: Values = (*_ALL1, (8, 2, 4095), (11, 1, 80), (13, 1, 160), (22, 1, 1))
_AX: Values = (*_ALL1, (8, 2, 1023), (11, 1, 70), (13, 1, 140))
FACTORY1: dict[str, Values] = {
    "MX-12W": (*_MX1, (26, 1, 8), (28, 1, 8), (48, 2, 32)),  # D, P, punch
    "MX": (*_MX1, (28, 1, 32)),
    "AX": (*_AX, *((k, 1, 1) for k in (26, 27)), *((k, 1, 32) for k in (28, 29)), (48, 2, 32)),  # compliance, punch
}


def factory_values(model: Model) -> Values:
    """Return the nonzero registers of a new servo of this model."""
    if model.protocol == 1:
        return next(values for name, values in FACTORY1.items() if model.name.startswith(name))
    return next(factory for name, factory in FACTORY2.items() if model.name.startswith(name)).values(model)


def indirect_blocks(model: Model) -> tuple[tuple[int, int, int], ...]:
    """Return address of Indirect Address, address of Indirect Data and count, for each block."""
    if model.protocol == 1:
        return ()
    if model.layout is LAYOUT_P:
        return ((168, 634, 128),)
    if model.name.startswith(("XL330", "XC330")):
        return ((168, 208, 20),)
    return ((168, 224, 28), (578, 634, 28))
