"""`dense_positions.py EXTENDED.toml RECORDING.csv OUT.npy`: predict marker positions with an extended simulation.

Runs in the checkout whose diagnosis wrote the file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from bodyschema.effects import Motion, load_simulation
from bodyschema.recordings.recording import Recording


def main(extended: Path, recording: Path, out: Path) -> None:
    """Write positions (n, 3) [m]."""
    simulation = load_simulation(extended)
    np.save(out, simulation.positions(Motion.of(Recording.read(recording, simulation.robot.joints))))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
