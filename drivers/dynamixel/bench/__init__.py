"""A chain of servos at the bytes, below any driver: for tests, and to try a configuration without an arm.

`chain.Chain` is the protocol, bytes in and bytes with times out; `virtual_port` runs it in virtual time, `pty_shell` on
a pseudo-terminal that any program opens like a serial port.
"""

from __future__ import annotations
