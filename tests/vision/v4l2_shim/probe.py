"""Program that reads frames from cameras given as [vision.cameras] (JSON on standard input) and reports them as JSON.

python probe.py FRAMES
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import msgspec

from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.vision.cameras.config import CamerasConfig
from bodyschema.vision.cameras.live import LiveEyes
from bodyschema.vision.cameras.opened import eyes_of


def main() -> None:
    config = msgspec.json.decode(sys.stdin.buffer.read(), type=CamerasConfig)
    eyes = eyes_of(config, Path(), SystemClock())
    assert isinstance(eyes, LiveEyes)
    told = {"t": [], "behind": [], "sigma": [], "levels": [], "health": [], "error": ""}
    try:
        with eyes:
            print("open", file=sys.stderr, flush=True)
            while len(told["t"]) < int(sys.argv[1]):
                frame = eyes.read(0.2)
                if frame is not None:
                    told["t"].append(frame.t)
                    told["behind"].append(time.monotonic() - frame.t)
                    told["sigma"].append(frame.t_sigma)
                    told["levels"].append([int(frame.left.mean()), int(frame.right.mean())])
            told["health"] = list(eyes.health)
            told["stamps"] = [figures.stamps for figures in eyes.figures]
            told["damaged"] = [figures.damaged for figures in eyes.figures]
            told["fps"] = [figures.fps for figures in eyes.figures]
            told["serials"] = eyes.serials
    except BodyschemaError as error:
        told["error"] = f"{type(error).__name__}: {error}"
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
