"""All that is asked when ports are scanned."""

from __future__ import annotations

from .dynamixel.scan import PROTOCOL1, Protocol2Scanner
from .feetech.scan import FEETECH_SERVOS
from .servos.scan import PingScanner

# PING is the same in Protocol 1.0 and Feetech's: both are found in one go.
SCANNERS = (Protocol2Scanner(), PingScanner(PROTOCOL1, FEETECH_SERVOS))
