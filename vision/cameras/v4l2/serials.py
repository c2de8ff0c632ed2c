"""Identify cameras by serial number, and list those of this machine."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path("/")
BY_ID, BY_PATH = "dev/v4l/by-id", "dev/v4l/by-path"
USB_SERIAL = "sys/class/video4linux/{}/device/../serial"
# A camera has more devices than one; the first is the one that sends images.
IMAGES = "-video-index0"


def serial_of(device: str, root: Path = ROOT) -> str:
    """Return a camera's serial number from sysfs; without one, its name under by-id or as given."""
    node = Path(os.path.realpath(device)).name
    try:
        serial = (root / USB_SERIAL.format(node)).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        serial = ""
    return serial or Path(device).name.removesuffix(IMAGES)


def connected(root: Path = ROOT) -> list[str]:
    """Return the cameras on this machine by their persistent names: by-id, or by-path if two share that."""
    named: dict[str, str] = {}
    for folder in (BY_PATH, BY_ID):  # the better name last
        for link in sorted((root / folder).glob(f"*{IMAGES}")):
            named[os.path.realpath(link)] = str(link)
    return sorted(named.values())
