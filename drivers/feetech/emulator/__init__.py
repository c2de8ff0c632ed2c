"""Emulator of a chain of Feetech servos at the byte level, for tests and for trying a configuration without an arm."""
