"""Benches at the bytes: a port in virtual time or on a pseudo-terminal, and what can go wrong on the way.

What sits behind the port is a `device.Device`: a chain of servos (`drivers/dynamixel/bench`, `drivers/feetech/bench`)
or encoders that talk of themselves (`drivers/serial_lines/bench`).
"""

from __future__ import annotations
