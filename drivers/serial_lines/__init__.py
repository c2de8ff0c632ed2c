"""Own encoders on a microcontroller that speaks lines of text: the driver, and below `bench` such a board."""

from __future__ import annotations
