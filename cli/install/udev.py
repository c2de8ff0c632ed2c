"""Install udev rules for the serial ports of servos and encoders."""

from __future__ import annotations

from pathlib import Path

from .machine_files import MachineFiles

FILE = Path("etc/udev/rules.d/60-bodyschema.rules")
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


class UdevRules(MachineFiles):
    """The rules file of a machine."""

    kind = "udev"
    reload = (("udevadm", "control", "--reload-rules"), ("udevadm", "trigger", "--subsystem-match=tty", "--action=add"))
    is_used = "Plug the adapter in again; `bodyschema doctor` checks it."

    def texts(self) -> dict[Path, str]:
        """Return the contents of the file."""
        return {self.root / FILE: rules()}

    def installed(self) -> list[Path]:
        return [file for file in self.texts() if file.exists()]
