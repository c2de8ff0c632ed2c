"""Commands that calibrate, diagnose, and replay recordings."""
