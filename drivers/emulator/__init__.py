"""Emulator at the byte level: a port in virtual time or on a pseudo-terminal, with fault injection.

Behind the port is a `device.Device`: a chain of servos (`drivers/dynamixel/emulator`, `drivers/feetech/emulator`) or
encoders that send unasked (`drivers/serial_lines/emulator`).
"""
