"""EEPROM settings of a servo that a command may change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.suggest import did_you_mean

from .model import Register

ID, BAUD, HOMING_OFFSET = "id", "baud", "homing_offset"
LARGEST_ID = 252  # 253 is legal, but no robot.toml can name it
RENAMED = "set id in robot.toml"
OTHER_RATE = "set baud in robot.toml; all servos of a bus need the same"
OTHER_ZERO = "the joint's zero moves: samples measured before do not fit those after"


@dataclass(frozen=True, slots=True)
class Setting:
    """A number in a servo's EEPROM."""

    name: str  # for commands
    register: Register  # where it is stored
    # lowest, highest: its bounds
    lowest: int
    highest: int
    # named values. If there are any, no other value is allowed.
    words: Mapping[str, int] = field(default_factory=dict, repr=False)
    # per_unit, unit: value and unit of one count, for display; no unit: a plain number
    per_unit: float = 1.0
    unit: str = ""
    follows: str = ""  # consequence of a change for a calibrated arm

    def value(self, text: str) -> int:
        """Parse the user's value; raise ConfigError if it is invalid for this setting, or out of range."""
        if text in self.words:
            return self.words[text]
        try:
            value = int(text, 0)
        except ValueError:
            remedy = did_you_mean(text, self.words) if self.words else self.range
            raise ConfigError(f"{self.name}={text}: {text!r} is no value of it", remedy=remedy) from None
        if self.words and (self.name == BAUD or value not in self.words.values()):
            raise ConfigError(f"{self.name}={text}: there is no such value", remedy=self.range)
        if not self.lowest <= value <= self.highest:
            raise ConfigError(f"{self.name}={text} is out of range", remedy=self.range)
        return value

    def shown(self, value: int) -> str:
        """Format a value for display, as "250 (500 µs)"."""
        word = next((word for word, known in self.words.items() if known == value), "")
        if self.name == BAUD:
            return f"{int(word):,} bit/s" if word else f"{value} (unknown rate)"
        if word:
            return f"{value} ({word})"
        return f"{value} ({value * self.per_unit:.4g} {self.unit})" if self.unit else str(value)

    @property
    def range(self) -> str:
        """Allowed values, as text."""
        if self.name == BAUD:
            return f"Give one of {', '.join(self.words)}"
        if self.words:
            return f"Give one of {', '.join(f'{word} ({value})' for word, value in self.words.items())}"
        return f"Give a number from {self.lowest} to {self.highest}"


def setting_called(name: str, settings: Mapping[str, Setting], model: str) -> Setting:
    """Return the setting of that name; raise ConfigError if the model has no writable one."""
    if name not in settings:
        what = f"{model} has no setting {name!r} that may be written"
        raise ConfigError(what, remedy=did_you_mean(name, settings))
    return settings[name]
