"""A sampler process with emulated servos, its cameras' images, and its output."""

from __future__ import annotations

import contextlib
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import warm

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.keys import CommandName, Keys
from bodyschema.daemon.transport.session import ZenohSession
from bodyschema.daemon.transport.status import SamplerStatus
from bodyschema.daemon.transport.wire import CommandReply, CommandRequest, decode, encode
from bodyschema.daemon.wiring.emulators import Motion, emulator_robot_file, open_emulator
from bodyschema.drivers.emulator.dry_run import DryRun
from bodyschema.interfaces.errors import BodyschemaError
from bodyschema.interfaces.records import FloatArray, Pair
from bodyschema.recordings.store.store import PairReader

LIMIT_S = 500.0


def limb(x: FloatArray, radius_m: float) -> FloatArray:
    """Return points (n, 3) of the contour circle where rays from the origin touch a sphere at x (3,) [m]."""
    shrunk = 1.0 - radius_m**2 / float(x @ x)
    across = np.linalg.svd(x[None])[2][1:]
    turns = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    return shrunk * x + radius_m * math.sqrt(shrunk) * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ across


def drawn(config: Config, q: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Render the two cameras' images of the marker ball."""
    return eyes_at(config, config.robot.chain.positions(q[None])[0])


def eyes_at(config: Config, x: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Render the two cameras' images of the marker ball at x (3,) [m] in front of the left one."""
    calibration = config.robot.calibration
    assert calibration is not None
    width, height = calibration.image_size_px
    eyes = []
    for eye in range(2):
        seen = limb(x - [eye * calibration.baseline_m, 0.0, 0.0], config.tables.vision.radius_m)
        outline_px = calibration.focal_px * seen[:, :2] / seen[:, 2:] + calibration.principal_point_px
        image = np.full((height, width, 3), 128, np.uint8)
        # Only the ball's surroundings are drawn at twice the size and averaged.
        left, top = np.clip(np.floor(outline_px.min(axis=0)).astype(int) - 2, 0, (width, height))
        right, bottom = np.clip(np.ceil(outline_px.max(axis=0)).astype(int) + 3, 0, (width, height))
        if left < right and top < bottom:
            part = np.full((2 * (bottom - top), 2 * (right - left), 3), 128, np.uint8)
            corners = np.round(16 * (2 * (outline_px - [left, top]) + 0.5)).astype(np.int32)
            cv2.fillPoly(part, [corners], (30, 30, 220), cv2.LINE_AA, 4)
            size = int(right - left), int(bottom - top)
            image[top:bottom, left:right] = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
        eyes.append(image)
    return eyes[0], eyes[1]


@contextlib.contextmanager
def on_emulator(config: Config, folder: Path, angle: Callable[[float], FloatArray]) -> Iterator[tuple[Config, DryRun]]:
    """Yield the same arm with emulated servos moving along `angle`, and the emulator."""
    motion = {name: lambda t, j=j: float(angle(t)[j]) for j, name in enumerate(config.robot.joints)}
    emulator = open_emulator(config, folder / "bus", Motion(motion, "test"), return_delay_s=0.0, seed=0)
    file = emulator_robot_file(config, emulator, folder / "bus")
    with emulator:
        yield Config.load(file, {}), emulator


class SamplerProcess:
    """A running `bodyschema run sampler`."""

    def __init__(
        self, config: Config, bus: ZenohSession, process: subprocess.Popen[bytes] | warm.Child, log: Path
    ) -> None:
        self.process, self._bus, self._log = process, bus, log
        self._keys = Keys(config.robot.name)

    def status(self) -> SamplerStatus:
        """Return the sampler's status once it answers."""
        return decode(self._answer(lambda: self._bus.ask_one(self._keys.status("sampler"))), SamplerStatus)

    def command(self, name: CommandName) -> str:
        """Send a command like `bodyschema command` and return the reply."""
        reply = self._bus.ask_one(self._keys.command("sampler"), encode(CommandRequest(name)))
        return decode(reply, CommandReply).message

    def said(self) -> str:
        """Return its terminal output so far."""
        return self._log.read_text()

    def _answer(self, ask: Callable[[], bytes]) -> bytes:
        until = time.monotonic() + LIMIT_S
        while True:
            try:
                return ask()
            except BodyschemaError:
                assert self.process.poll() is None, self.said()
                assert time.monotonic() < until


@contextlib.contextmanager
def sampling(config: Config, environment: dict[str, str] | None = None) -> Iterator[SamplerProcess]:
    """Run a sampler process."""
    words = ["-m", "bodyschema", "run", "sampler", "--robot", config.file]
    log = config.file.with_suffix(".log")
    with log.open("w") as errors:
        if environment:  # the environment applies to new processes
            process = subprocess.Popen([sys.executable, *words], env=environment, stderr=errors)
        else:
            process = warm.Child(*words, stderr=errors)
    try:
        with ZenohSession(connect=config.tables.zenoh.sampler) as bus:
            yield SamplerProcess(config, bus, process, log)
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            assert process.wait(LIMIT_S) == 0
    finally:
        process.kill()
        process.wait()


def until(sampler: SamplerProcess, holds: Callable[[SamplerStatus], bool]) -> SamplerStatus:
    """Return the sampler's status once the condition holds."""
    limit = time.monotonic() + LIMIT_S
    while not holds(said := sampler.status()):
        assert time.monotonic() < limit, (said.rejected, said)
        time.sleep(0.05)
    return said


def pairs_of(config: Config) -> list[Pair]:
    with PairReader(config.store_file) as reader:
        return list(reader.read())
