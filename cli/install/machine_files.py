"""Files of a machine's configuration that are written, shown and removed together."""

from __future__ import annotations

import os
import shutil
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

from bodyschema.interfaces.errors import ConfigError

ROOT = Path("/")
Command = Sequence[str]


def run_quietly(command: Command) -> None:
    """Run the command; on a machine without it, do nothing."""
    if shutil.which(command[0]) is not None:
        subprocess.run(command, capture_output=True, check=False, timeout=10)


class MachineFiles(ABC):
    """Files below the root of a machine's file system.

    Args:
        root: that root; an image's, or this machine's.
        run: runs a command; only if `root` is this machine's.
    """

    kind: ClassVar[str]
    """As `bodyschema install` calls them."""
    reload: Sequence[Command]
    """Makes the system read the files again."""
    is_used: str
    """What the user does next."""
    before_removal: Sequence[str] = ()
    """What happens before the files are removed."""
    stays: ClassVar[str] = ""
    """What is not removed."""

    def __init__(self, root: Path = ROOT, run: Callable[[Command], None] = run_quietly) -> None:
        self.root, self._run = root, run

    @abstractmethod
    def installed(self) -> list[Path]:
        """Return the files that `uninstall` would remove."""

    def install(self, texts: dict[Path, str]) -> None:
        """Write files with their contents, and let the system read them; raise ConfigError if one cannot be written."""
        for file, text in texts.items():
            with writing(file, f"install {self.kind}"):
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_text(text, encoding="utf-8")
        self._call(self.reload)

    def uninstall(self) -> None:
        """Remove the files, and folders of drop-ins that become empty; raise ConfigError if one cannot be removed."""
        for file in self.installed():
            with writing(file, f"install {self.kind} --uninstall"):
                file.unlink()
                # `systemctl edit` puts the user's files there; other folders are the system's.
                if file.parent.match("*.service.d") and not any(file.parent.iterdir()):
                    file.parent.rmdir()
        self._call(self.reload)

    def _call(self, commands: Sequence[Command]) -> None:
        for command in commands if self.root == ROOT else ():
            self._run(command)


@contextmanager
def writing(file: Path, command: str) -> Iterator[None]:
    """Convert an OSError about `file` to a ConfigError; `command` is the `bodyschema` command for the remedy."""
    try:
        yield
    except OSError as error:
        remedy = f'Type: sudo "$(command -v bodyschema)" {command} --yes'
        if os.geteuid() == 0:
            remedy = "Look at the file system of that folder"
        raise ConfigError(f"cannot be changed: {error.strerror}", file=file, remedy=remedy) from error


def missing(texts: dict[Path, str]) -> dict[Path, str]:
    """Return those files that do not exist with these contents."""
    return {file: text for file, text in texts.items() if not file.exists() or file.read_text("utf-8") != text}


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
        lines += [f"# {name}", f'{match}, GROUP="dialout", MODE="0660", TAG+="uaccess", ENV{{ID_MM_DEVICE_IGNORE}}="1"']
    return "\n".join(lines) + "\n"


class UdevRules(MachineFiles):
    kind = "udev"
    reload = (("udevadm", "control", "--reload-rules"), ("udevadm", "trigger", "--subsystem-match=tty", "--action=add"))
    is_used = "Plug the adapter in again; `bodyschema doctor` checks it."

    def texts(self) -> dict[Path, str]:
        """Return the contents of the file."""
        return {self.root / FILE: rules()}

    def installed(self) -> list[Path]:
        return [file for file in self.texts() if file.exists()]
