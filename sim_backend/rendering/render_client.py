"""The world's side of the renderer's process."""

from __future__ import annotations

import mmap
import os
import select
import subprocess
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Self

import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.errors import SourceLost
from bodyschema.interfaces.interpreter import module_command
from bodyschema.interfaces.records import ImageArray
from bodyschema.interfaces.waits import Waits
from bodyschema.sim_backend.bullet import PhysicsUrdf
from bodyschema.sim_backend.config import SimConfig
from bodyschema.sim_backend.truth import TrueRobot

from .render_messages import SLOTS, Frame, Setup, Tool, frame_bytes, send, slot_images
from .scene import Scene


class RenderProcess:
    """Client that starts the renderer, sends scenes and fetches images, in order; at most SLOTS frames are in progress.

    The images are in anonymous memory that the kernel frees with its last user: nothing is left behind, however
    either process ends.
    """

    def __init__(self, urdf: PhysicsUrdf, truth: TrueRobot, calibration: StereoCalibration, config: SimConfig) -> None:
        calibration = truth.true_calibration(calibration)
        self._setup = Setup(
            urdf=urdf,
            joints=truth.robot.joints,
            marker_link=truth.robot.robot.marker_link,
            focal_px=calibration.focal_px,
            principal_point_px=calibration.principal_point_px,
            baseline_m=calibration.baseline_m,
            image_size_px=calibration.image_size_px,
            camera=config.camera,
            seed=config.seed,
        )
        self._exit = ExitStack()

    def __enter__(self) -> Self:
        size = SLOTS * frame_bytes(self._setup)
        with ExitStack() as stack:
            memory = os.memfd_create("bodyschema_frames")
            stack.callback(os.close, memory)
            os.ftruncate(memory, size)
            self._shared = stack.enter_context(mmap.mmap(memory, size))
            its_requests, requests = os.pipe()
            self._answers, its_answers = os.pipe()
            stack.callback(os.close, self._answers)
            try:
                self.process = _start(memory, its_requests, its_answers)
            finally:
                os.close(its_requests)
                os.close(its_answers)
            stack.callback(self._end)
            self._requests = stack.enter_context(Connection(requests, readable=False))
            self._send(self._setup)
            self._tip: tuple[float, float, float] | None = None
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def request(self, number: int, scene: Scene) -> None:
        """Request frame `number`, with a stick from the hand to the end of the tool."""
        tip = (float(scene.tip[0]), float(scene.tip[1]), float(scene.tip[2]))
        if tip != self._tip:
            self._send(Tool(tip=tip))
            self._tip = tip
        self._send(
            Frame(
                number=number,
                angles=scene.angles.tolist(),
                T_world_camera=scene.T_world_camera.ravel().tolist(),
                x_eyes=scene.x_eyes.ravel().tolist(),
                R_camera_marker=scene.R_camera_marker.ravel().tolist(),
            )
        )

    def fetch(self, number: int, timeout_s: float) -> tuple[ImageArray, ...] | None:
        """Return a copy of the images of frame `number`, the earliest not yet fetched; None after `timeout_s`.

        Raises:
            SourceLost: the renderer's process has died.
        """
        if not select.select([self._answers], [], [], max(0.0, timeout_s))[0]:
            return None
        if not os.read(self._answers, 1):
            raise self._lost()
        return tuple(np.array(image) for image in slot_images(self._shared, number, self._setup))

    def _send(self, message: Setup | Tool | Frame) -> None:
        try:
            send(self._requests, message)
        except BrokenPipeError as error:
            raise self._lost() from error

    def _lost(self) -> SourceLost:
        self._end()  # its pipes close a moment before it ends, and the next opening asks if it has ended
        return SourceLost(
            f"the renderer's process {self.process.pid} has ended (exit code {self.process.poll()}); "
            "its message stands on standard error; open the simulation again"
        )

    def _end(self) -> None:
        try:
            self.process.wait(Waits.end_limit_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _start(memory: int, requests: int, answers: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        module_command("bodyschema.sim_backend.rendering.renderer", str(memory), str(requests), str(answers)),
        pass_fds=(memory, requests, answers),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        process_group=0,  # the parent handles a signal to the group
    )
