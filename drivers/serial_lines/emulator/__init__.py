"""Emulator of an encoder board at the byte level, for tests and for trying a configuration without an arm."""
