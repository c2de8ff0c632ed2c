"""Messages from the world to its renderer: MessagePack over a pipe."""

from __future__ import annotations

from multiprocessing.connection import Connection
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import ImageArray
from bodyschema.sim_backend.bullet import PhysicsUrdf
from bodyschema.sim_backend.config import CameraConfig

# Frames in the shared memory; more than can be under way at once.
SLOTS = 4


class Setup(msgspec.Struct, frozen=True, tag=True):
    """The robot and the cameras. Comes first, once."""

    urdf: PhysicsUrdf
    joints: tuple[str, ...]
    marker_link: str
    focal_px: float
    principal_point_px: tuple[float, float]
    baseline_m: float
    image_size_px: tuple[int, int]
    camera: CameraConfig
    seed: int

    @property
    def calibration(self) -> StereoCalibration:
        return StereoCalibration(self.focal_px, self.principal_point_px, self.baseline_m, self.image_size_px)

    @property
    def eyes(self) -> int:
        return len(self.calibration.eyes_m)


class Tool(msgspec.Struct, frozen=True, tag=True):
    """A stick from the marker link's origin to `tip` [m], in the marker link."""

    tip: tuple[float, float, float]


class Frame(msgspec.Struct, frozen=True, tag=True):
    """Request to paint this frame into slot `number` modulo SLOTS, answered with one byte."""

    number: int
    angles: list[float]  # true joint angles [rad or m]
    T_world_camera: list[float]  # pose of the left eye, row by row, 16 numbers
    # apparent position of the marker's centre in the left, then the right eye's frame [m], 3 numbers each
    x_eyes: list[float]
    R_camera_marker: list[float]  # orientation of the marker in the left eye's frame, row by row, 9 numbers


Message = Setup | Tool | Frame
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Message)


def send(pipe: Connection, message: Message) -> None:
    """Write a message; raise BrokenPipeError if the reader is gone."""
    pipe.send_bytes(_encoder.encode(message))


def receive(pipe: Connection) -> Message | None:
    """Return the next message; None at the end of the pipe, even in the middle of one."""
    try:
        return _decoder.decode(pipe.recv_bytes())
    except (EOFError, OSError):
        return None


def frame_bytes(setup: Setup) -> int:
    """Return the size of one frame [bytes], the images of all eyes together."""
    width, height = setup.image_size_px
    return setup.eyes * width * height * 3


def slot_images(shared: Any, number: int, setup: Setup) -> tuple[ImageArray, ...]:
    """Return each eye's image (height, width, 3), the left one first, of frame `number` in the shared memory."""
    width, height = setup.image_size_px
    size = frame_bytes(setup)
    pixels = np.frombuffer(shared, dtype=np.uint8, count=size, offset=(number % SLOTS) * size)
    return tuple(pixels.reshape(setup.eyes, height, width, 3))
