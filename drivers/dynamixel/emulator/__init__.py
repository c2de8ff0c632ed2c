"""Emulator of a chain of Dynamixel servos at the byte level, for tests and for trying a configuration without an arm.

`chain.Chain` is the protocol, bytes in and timed bytes out; `pty_shell` runs it on a
pseudo-terminal that any program opens like a serial port.
"""
