"""The renderer: `python -m bodyschema.sim_backend.rendering.renderer MEMORY REQUESTS ANSWERS`, inherited descriptors.

It ends when its parent closes the pipe or has exited: then its frames have no reader.
"""

from __future__ import annotations

import mmap
import os
import signal
import sys
from multiprocessing.connection import Connection

import cv2
import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray
from bodyschema.sim_backend.bullet import Body
from bodyschema.sim_backend.geometry import turn_of_z
from bodyschema.sim_backend.physics_urdf import UrdfSettings
from kbmaps.rotations import quaternions

from .raster import Raster
from .render_messages import SLOTS, Frame, Message, Setup, Tool, frame_bytes, receive, slot_images
from .stereo_renderer import TO_LIGHT, StereoRenderer


class ToolStick:
    """The tool: a thin, massless rod from the hand to the ball, visible but without collisions."""

    def __init__(self, body: Body, link: str) -> None:
        self._body, self._link = body, link
        self._id = -1
        self._T_link_stick: tuple[FloatArray, FloatArray] = (np.zeros(3), np.eye(3))

    def change(self, tip: FloatArray) -> None:
        """Replace the stick by one to `tip` (3,) [m] in the link."""
        bullet, client = self._body.bullet, self._body.client
        if self._id >= 0:
            bullet.removeBody(self._id, physicsClientId=client)
            self._id = -1
        length = float(np.linalg.norm(tip))
        # A marker fixed in the world, in front of a camera on the arm, is on no stick.
        if length < UrdfSettings.shortest_rod_m or self._body.stands(self._link):
            return
        shape = bullet.createVisualShape(
            bullet.GEOM_CYLINDER,
            radius=UrdfSettings.rod_radius_m,
            length=length,
            rgbaColor=[0.16, 0.17, 0.18, 1],
            physicsClientId=client,
        )
        self._id = bullet.createMultiBody(0, -1, shape, physicsClientId=client)
        self._T_link_stick = (tip / 2, turn_of_z(tip / length))

    def follow(self) -> None:
        """Move the rod to the link's present pose."""
        if self._id < 0:
            return
        T = self._body.link_pose(self._link)
        middle, turn = self._T_link_stick
        self._body.bullet.resetBasePositionAndOrientation(
            self._id,
            (T[:3, :3] @ middle + T[:3, 3]).tolist(),
            quaternions((T[:3, :3] @ turn)[None])[0].tolist(),
            physicsClientId=self._body.client,
        )


def serve(memory: int, requests: int, answers: int) -> None:
    """Paint frames until the requests end."""
    pipe = Connection(requests, writable=False)
    setup = _next(pipe)
    if not isinstance(setup, Setup):
        return
    calibration = setup.calibration
    with Body(setup.urdf, setup.joints) as body, mmap.mmap(memory, SLOTS * frame_bytes(setup)) as shared:
        raster = Raster(body.bullet, body.client, calibration, TO_LIGHT)
        eyes = StereoRenderer(raster, calibration, setup.camera, setup.seed)
        stick = ToolStick(body, setup.marker_link)
        while (message := _next(pipe)) is not None:
            if isinstance(message, Tool):
                stick.change(np.array(message.tip))
            elif isinstance(message, Frame):
                _paint(message, body, stick, eyes, slot_images(shared, message.number, setup))
                os.write(answers, b"\0")


def _paint(frame: Frame, body: Body, stick: ToolStick, eyes: StereoRenderer, images: tuple[ImageArray, ...]) -> None:
    body.set_angles(np.array(frame.angles))
    stick.follow()
    T_world_camera, x_eyes = np.array(frame.T_world_camera).reshape(4, 4), np.array(frame.x_eyes).reshape(-1, 3)
    eyes.paint(frame.number, T_world_camera, x_eyes, np.array(frame.R_camera_marker).reshape(3, 3), images)


def _next(pipe: Connection, check_s: float = 1.0) -> Message | None:
    """Return the next request; None if the parent closed the pipe or is gone (its fork may keep the pipe open)."""
    parent = os.getppid()
    while not pipe.poll(check_s):
        if os.getppid() != parent:
            return None
    return receive(pipe)


if __name__ == "__main__":
    cv2.setNumThreads(1)  # the other processor is the tracker's
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle; it closes the pipe
    try:
        serve(*(int(argument) for argument in sys.argv[1:4]))
    except BrokenPipeError:
        os._exit(0)
