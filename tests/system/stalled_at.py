"""Run `bodyschema` and let a loop hang, as a device or a disk would, while a file of its name is in a folder.

python stalled_at.py FOLDER sampler --robot robot.toml
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodyschema.cli.main import main

# The work of each loop in one round.
WORK = {
    "encoders": ("bodyschema.daemon.sampler.reconnect", "ReconnectingSource", "read", "the encoders"),
    "frames": ("bodyschema.daemon.sampler.reconnect", "ReconnectingSource", "read", "the cameras"),
    "learning": ("bodyschema.daemon.learner.feed", "PairFeed", "step", None),
    "background": ("bodyschema.daemon.learner.findings", "Findings", "renew", None),
    "status": ("bodyschema.daemon.learner.learner", "Learner", "status", None),
}


def hanging(work: Callable[..., Any], name: str | None, file: Path) -> Callable[..., Any]:
    def doomed(self: Any, *arguments: Any) -> Any:
        while name in (None, getattr(self, "_name", None)) and file.exists():
            time.sleep(0.01)
        return work(self, *arguments)

    return doomed


if __name__ == "__main__":
    folder = Path(sys.argv.pop(1))
    for loop, (module, kind, method, name) in WORK.items():
        owner = getattr(importlib.import_module(module), kind)
        setattr(owner, method, hanging(getattr(owner, method), name, folder / loop))
    main()
