"""Stereo frames a second on one core: `python benchmarks/tracking.py [--frames N]`.

Two variants: the tracker alone, with its region of interest or searching the whole images each time; and the sampler's
process as it runs beside the hardware: tracker, time alignment, gate, store and publication. Frames (640x480) and
encoder readings come from memory; they were recorded from the simulated robot, so rendering is not timed. The variants
take turns.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import cv2

from bodyschema.daemon.config import Config
from bodyschema.daemon.sampler.devices import session_of
from bodyschema.daemon.sampler.sampler import Sampler
from bodyschema.daemon.sampler.sources import Sources
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.clock import SystemClock
from bodyschema.interfaces.errors import SourceEnded
from bodyschema.interfaces.records import JointReading, MarkerMiss, StereoFrame
from bodyschema.recordings.store.store import PairStore
from bodyschema.sim_backend import SimWorld, model_file
from bodyschema.vision.ball.tracker import StereoTracker
from bodyschema.vision.config import VisionConfig
from bodyschema.vision.tracked_camera import TrackedCamera

CAMERA_HZ = 30.0
T = TypeVar("T")


class FromMemory(Generic[T]):
    """A source that returns recorded items as fast as it is read."""

    def __init__(self, items: list[T], calibration: StereoCalibration, joints: tuple[str, ...] = ()) -> None:
        self.calibration, self.joints = calibration, joints
        self._items = items
        self._rest = iter(items)

    def __enter__(self) -> Self:
        self._rest = iter(self._items)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def read(self, timeout_s: float) -> T:  # noqa: ARG002
        """Return the next item; raise SourceEnded after the last."""
        for item in self._rest:
            return item
        raise SourceEnded("all frames are through")


def record(config: Config, frames: int) -> tuple[list[StereoFrame], list[JointReading]]:
    """Record camera frames and encoder readings of the simulated robot while it is guided."""
    seen: list[StereoFrame] = []
    readings: list[JointReading] = []
    with SimWorld(config.robot, config.tables.sim) as world, world.joints as joints, world.camera as camera:
        while len(seen) < frames:
            frame = camera.read(30.0)
            if frame is None:
                continue
            seen.append(frame)
            while not readings or readings[-1].t < frame.t:
                reading = joints.read(30.0)
                if reading is not None:
                    readings.append(reading)
    return seen, readings


def track(calibration: StereoCalibration, config: VisionConfig, frames: list[StereoFrame], *, forget: bool) -> str:
    """Track all frames; return a line about the fixes."""
    tracker = StereoTracker(calibration, config)
    missed: Counter[str] = Counter()
    for frame in frames:
        if forget:
            tracker.forget()
        answer = tracker.track(frame)
        if isinstance(answer, MarkerMiss):
            missed[answer.reason] += 1
    return _described(f"{len(frames) - missed.total()} fixes", dict(missed))


def sample(config: Config, sources: Sources) -> str:
    """Run a sampler with its own store until the sources end; return a line about the frames."""
    with tempfile.TemporaryDirectory() as folder:
        mine = config.with_state_dir(Path(folder))
        with (
            PairStore(mine.store_file, session_of(mine, SystemClock())) as store,
            ZenohSession(listen=_endpoint()) as bus,
        ):
            sampler = Sampler(mine, sources, bus, store, exit_at_end=True)
            sampler.run()
            status = sampler.status()
    return _described(f"{status.pairs} pairs", dict(status.rejected))


def timed(rivals: dict[str, Callable[[], str]], rounds: int) -> dict[str, tuple[list[float], str]]:
    """Return the seconds of each round, and the last result; each round runs every rival under the same load."""
    results: dict[str, tuple[list[float], str]] = {name: ([], "") for name in rivals}
    for _ in range(rounds):
        for name, run in rivals.items():
            begin = time.perf_counter()
            said = run()
            results[name] = ([*results[name][0], time.perf_counter() - begin], said)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=240, help="stereo frames to record, then to time")
    parser.add_argument("--rounds", type=int, default=5, help="times that each rival runs")
    arguments = parser.parse_args()
    config = Config.load(model_file("upper_body"), {})
    calibration = config.robot.calibration
    assert calibration is not None
    frames, readings = record(config, arguments.frames)
    _keep_to_one_core()

    def sources() -> Sources:
        camera: Any = FromMemory(frames, calibration)
        joints = FromMemory(readings, calibration, config.robot.joints)
        marker = TrackedCamera(camera, StereoTracker(calibration, config.tables.vision))
        return Sources(joints, marker, SystemClock())

    vision = config.tables.vision
    rivals = {
        "tracker, region of interest": lambda: track(calibration, vision, frames, forget=False),
        "tracker, whole images": lambda: track(calibration, vision, frames, forget=True),
        "sampler and tracker": lambda: sample(config, sources()),
    }
    width, height = calibration.image_size_px
    print(f"{len(frames)} stereo frames of {width}x{height}, one core, median of {arguments.rounds} rounds")
    for name, (seconds, said) in timed(rivals, arguments.rounds).items():
        rate, worst = (len(frames) / s for s in (statistics.median(seconds), max(seconds)))
        print(
            f"{name:28} {rate:6.0f} frames/s   {rate / CAMERA_HZ:5.1f} times {CAMERA_HZ:.0f}/s"
            f" (slowest round {worst / CAMERA_HZ:.1f})   {said}"
        )


def _described(first: str, rejected: dict[str, int]) -> str:
    return ", ".join([first, *(f"{number} {reason}" for reason, number in rejected.items() if number)])


def _endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def _keep_to_one_core() -> None:
    """Restrict all threads to one core from now on."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)


if __name__ == "__main__":
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        # Read when NumPy is imported.
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    main()
