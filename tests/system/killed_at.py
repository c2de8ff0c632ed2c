"""Runs `bodyschema` and kills it, as by SIGKILL from outside, at a named point.

python killed_at.py POINT NTH sampler --robot robot.toml
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daemon import checkpoint
from daemon.cli import main
from daemon.sampler import Sampler
from daemon.store import PairStore


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def around(owner: Any, name: str, nth: int, *, before: bool, only: Callable[..., bool] = lambda *_: True) -> None:
    """Die at the nth call of `owner.name`, before it or after it."""
    original = getattr(owner, name)
    calls = 0

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += only(*args)
        if before and calls == nth:
            die()
        result = original(*args, **kwargs)
        if calls == nth:
            die()
        return result

    setattr(owner, name, wrapped)


def half_written(nth: int) -> None:
    """Die when half of the nth checkpoint is on the disk."""
    calls = 0
    original = checkpoint._write_through

    def write(file: Path, data: bytes) -> None:
        nonlocal calls
        calls += 1
        original(file, data[: len(data) // 2] if calls == nth else data)
        if calls == nth:
            die()

    checkpoint._write_through = write


def to_checkpoint(_source: Path, target: Path) -> bool:
    return Path(target).name == "learner.ckpt"


POINTS: dict[str, Callable[[int], None]] = {
    "before the commit": lambda nth: around(PairStore, "append", nth, before=True),
    "between commit and publication": lambda nth: around(PairStore, "append", nth, before=False),
    "after the publication": lambda nth: around(Sampler, "_accept", nth, before=False),
    "in the middle of a checkpoint": half_written,
    "before the checkpoint's rename": lambda nth: around(os, "replace", nth, before=True, only=to_checkpoint),
    "after the checkpoint's rename": lambda nth: around(os, "replace", nth, before=False, only=to_checkpoint),
}

if __name__ == "__main__":
    POINTS[sys.argv[1]](int(sys.argv[2]))
    sys.argv[:] = ["bodyschema", *sys.argv[3:]]
    main()
