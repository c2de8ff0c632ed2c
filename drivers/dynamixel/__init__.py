"""Driver for Dynamixel servos, with an emulator in `bench`."""

from __future__ import annotations
