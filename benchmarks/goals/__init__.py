"""What this library set out to reach, measured: `python -m benchmarks.goals`."""
