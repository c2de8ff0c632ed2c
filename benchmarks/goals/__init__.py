"""Measured results against the goals of this library: `python -m benchmarks.goals`."""
