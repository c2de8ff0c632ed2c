"""Tasks from recordings of real robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.peers.problem import Problem
from benchmarks.peers.tasks import COUNTS, Task, Trial
from benchmarks.recording import RECORDED, Recording
from kbmaps import align

_LEAST_HELD_OUT = 30
_MOST_HELD_OUT = 500


@dataclass(frozen=True, eq=False)
class Splits:
    """Random splits of a recording: some pairs to learn, the others held out.

    The poses of the instrument and the reflector are fitted to the pairs first, for all competitors.
    """

    recording: Recording

    def __call__(self, seed: int, pairs: int) -> Trial | None:
        known = self.recording
        if pairs > len(known) - _LEAST_HELD_OUT:
            return None
        learnt, others = known.split(pairs, seed)
        held = others[-_MOST_HELD_OUT:]
        q, x = known.q[learnt], known.x[learnt]
        aligned = align(known.chain, q, x, pose_known=False, marker_known=False)
        problem = Problem(
            q=q,
            x=x,
            low=known.q.min(axis=0),
            high=known.q.max(axis=0),
            rng=np.random.default_rng([seed, 3]),
            drawing=aligned.chain,
            tolerances=RECORDED,
        )
        return Trial(problem, {"held out": (known.q[held], known.x[held])})


def recorded_tasks(data: Path | None) -> list[Task]:
    """Return one task per recording below `data`; none without `data`."""
    folders = [] if data is None else sorted(path.parent for path in data.glob("*/robot.toml"))
    return [
        Task(
            folder.name,
            f"Recording {folder.name}",
            Splits(Recording.load(folder)),
            counts=COUNTS,
            goals={30: 0.00012} if folder.name == "ur5_laser" else {},
            note="a real robot; error of held-out readings, their own noise included; aligned to the pairs first",
        )
        for folder in folders
    ]
