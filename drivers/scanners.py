"""Scanners of all supported protocols."""

from __future__ import annotations

from .dynamixel.scan import PROTOCOL1, Protocol2Scanner
from .feetech.scan import FEETECH_SERVOS
from .servos.scan import PingScanner

# PING is the same in Protocol 1.0 and in Feetech's protocol: one scan finds both.
SCANNERS = (Protocol2Scanner(), PingScanner(PROTOCOL1, FEETECH_SERVOS))
