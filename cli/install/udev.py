"""Install udev rules for the serial ports of servos and encoders."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodyschema.interfaces.errors import ConfigError

FILE = Path("etc/udev/rules.d/60-bodyschema.rules")
ROOT = Path("/")
# Vendor and product of USB adapters for servos, and of boards that read encoders: from published udev rules (ROBOTIS,
# SO-101, Reachy Mini) and outputs of lsusb and udevadm; not tried on hardware.
ADAPTERS = (
    ("0403", "6014", "FTDI FT232H: U2D2"),
    ("0403", "6001", "FTDI FT232R: USB2Dynamixel and many others"),
    ("2f5d", "2202", "ROBOTIS OpenRB-150"),
    ("fff1", "ff48", "ROBOTIS OpenCM 9.04"),
    ("0483", "5740", "STM32 with USB of its own: ROBOTIS OpenCR and others"),
    ("1a86", "7523", "WCH CH340: Feetech's FE-URT-1, older ones of Waveshare's, many Arduinos"),
    ("1a86", "55d3", "WCH CH343: Waveshare's bus servo adapter, boards of SO-100 and SO-101"),
    ("1a86", "55d4", "WCH CH9102: many ESP32 boards"),
    ("10c4", "ea60", "Silicon Labs CP210x: many ESP32 boards"),
    ("303a", "1001", "ESP32 with USB of its own"),
    ("2341", "0043", "Arduino Uno"),
)
_LATENCY = """\
# Adapters of FTDI keep bytes back for 16 ms, unless configured otherwise.
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
"""
RELOAD = (("udevadm", "control", "--reload-rules"), ("udevadm", "trigger", "--subsystem-match=tty", "--action=add"))

Run = Callable[[Sequence[str]], None]


def rules() -> str:
    """Return the text of the rules file."""
    lines = ["# Written by `bodyschema install udev`; `bodyschema install udev --uninstall` removes it.", "", _LATENCY]
    lines.append("# Users at the machine, and the group dialout, may open them; modem managers leave them alone.")
    for vendor, product, name in ADAPTERS:
        match = f'SUBSYSTEM=="tty", ATTRS{{idVendor}}=="{vendor}", ATTRS{{idProduct}}=="{product}"'
        lines += [
            f"# {name}",
            f'{match}, GROUP="dialout", MODE="0660", TAG+="uaccess", ENV{{ID_MM_DEVICE_IGNORE}}="1"',
        ]
    return "\n".join(lines) + "\n"


def run_quietly(command: Sequence[str]) -> None:
    """Run the command; on a machine without udev its output is useless."""
    if shutil.which(command[0]) is not None:
        subprocess.run(command, capture_output=True, check=False, timeout=10)


@dataclass(frozen=True, slots=True)
class Rules:
    """The rules file of a machine.

    Attributes:
        root: root of its file system.
        run: runs a command; only if `root` is this machine's.
    """

    root: Path = ROOT
    run: Run = run_quietly

    @property
    def file(self) -> Path:
        """The rules file."""
        return self.root / FILE

    @property
    def is_current(self) -> bool:
        """True if the file exists and is up to date."""
        return self.file.exists() and self.file.read_text(encoding="utf-8") == rules()

    def install(self) -> None:
        """Write the file, and let udev reload it.

        Raises:
            ConfigError: the file cannot be written.
        """
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self.file.write_text(rules(), encoding="utf-8")
        except OSError as error:
            raise self._refused(error, "") from error
        self._reload()

    def uninstall(self) -> bool:
        """Remove the file; return False if there was none.

        Raises:
            ConfigError: the file cannot be removed.
        """
        try:
            self.file.unlink()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise self._refused(error, " --uninstall") from error
        self._reload()
        return True

    def _reload(self) -> None:
        if self.root == ROOT:
            for command in RELOAD:
                self.run(command)

    def _refused(self, error: OSError, option: str) -> ConfigError:
        remedy = f'Type: sudo "$(command -v bodyschema)" install udev --yes{option}'
        if os.geteuid() == 0:
            remedy = "Look at the file system of that folder"
        return ConfigError(f"cannot be changed: {error.strerror}", file=self.file, remedy=remedy)
