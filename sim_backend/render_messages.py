"""What the world says to its renderer: length-prefixed MessagePack over a pipe."""

from __future__ import annotations

import os
import struct
from typing import Any

import msgspec
import numpy as np

from bodyschema.interfaces.camera import StereoCalibration
from bodyschema.interfaces.records import ImageArray

from .config import CameraConfig
from .physics_urdf import PhysicsUrdf

_LENGTH = struct.Struct("<I")
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
        """The eyes."""
        return StereoCalibration(self.focal_px, self.principal_point_px, self.baseline_m, self.image_size_px)

    @property
    def eyes(self) -> int:
        """How many there are."""
        return len(self.calibration.eyes_m)


class Tool(msgspec.Struct, frozen=True, tag=True):
    """A stick from the marker link's origin to `tip` [m], in the marker link."""

    tip: tuple[float, float, float]


class Frame(msgspec.Struct, frozen=True, tag=True):
    """Paint this frame into slot `number` modulo SLOTS, then answer with one byte.

    Attributes:
        angles: true joint angles [rad or m].
        T_world_camera: pose of the left eye, row by row, 16 numbers.
        x_eyes: where the marker's centre looks to be in the left, then in the right eye's frame [m], 3 numbers each.
        R_camera_marker: how it is turned there, row by row, 9 numbers.
    """

    number: int
    angles: list[float]
    T_world_camera: list[float]
    x_eyes: list[float]
    R_camera_marker: list[float]


Message = Setup | Tool | Frame
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Message)


def send(pipe: int, message: Message) -> None:
    """Write a message to a file descriptor; BrokenPipeError when nobody reads."""
    body = _encoder.encode(message)
    data = memoryview(_LENGTH.pack(len(body)) + body)
    while data:
        data = data[os.write(pipe, data) :]


def receive(pipe: int) -> Message | None:
    """The next message from a file descriptor; None at its end."""
    head = _read(pipe, _LENGTH.size)
    if head is None:
        return None
    body = _read(pipe, _LENGTH.unpack(head)[0])
    return None if body is None else _decoder.decode(body)


def frame_bytes(setup: Setup) -> int:
    """Bytes of one frame, all its eyes' images."""
    width, height = setup.image_size_px
    return setup.eyes * width * height * 3


def slot_images(shared: Any, number: int, setup: Setup) -> tuple[ImageArray, ...]:
    """The image (height, width, 3) of each eye, the left one first, of frame `number` in the shared memory."""
    width, height = setup.image_size_px
    size = frame_bytes(setup)
    pixels = np.frombuffer(shared, dtype=np.uint8, count=size, offset=(number % SLOTS) * size)
    return tuple(pixels.reshape(setup.eyes, height, width, 3))


def _read(pipe: int, count: int) -> bytes | None:
    parts: list[bytes] = []
    while count:
        part = os.read(pipe, count)
        if not part:
            return None
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
