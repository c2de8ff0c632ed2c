"""Dynamixel servos: the driver, and below `bench` a chain of them at the bytes."""

from __future__ import annotations
