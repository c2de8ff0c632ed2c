"""A recorded stretch of hand guiding without cameras, for tests to check."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.toml_file import read_toml
from bodyschema.sim_backend import SimConfig, model_file
from bodyschema.sim_backend.physics import Physics
from bodyschema.sim_backend.rendering.scene import Scene
from bodyschema.sim_backend.truth import TrueRobot


@dataclass(frozen=True)
class Run:
    """Recording at 30 Hz.

    Attributes:
        q: readings (n, d).
        x: true ball in the true left eye (n, 3) [m].
        visible: mask of the frames in which both cameras see the ball, in view and not hidden (n,).
    """

    robot: RobotDescription
    q: FloatArray
    x: FloatArray
    visible: np.ndarray


def shipped() -> RobotDescription:
    return RobotDescription.load(model_file("upper_body"))


def learning(joints: tuple[str, ...]) -> RobotDescription:
    """Return the shipped robot with other joints to learn."""
    file = model_file("upper_body")
    tables, text = read_toml(file)
    tables["robot"]["joints"] = list(joints)
    return RobotDescription.from_tables(tables, text, file)


def described(folder: Path, urdf: str, toml: str) -> RobotDescription:
    """Write and load a robot of the user's own."""
    (folder / "robot.urdf").write_text(urdf, encoding="utf-8")
    (folder / "robot.toml").write_text(toml, encoding="utf-8")
    return RobotDescription.load(folder / "robot.toml")


def in_eye(scene: Scene) -> FloatArray:
    """Return the ball (3,) in the left eye [m]."""
    return (np.linalg.inv(scene.T_world_camera) @ np.append(scene.x_world, 1.0))[:3]


def guide(
    robot: RobotDescription,
    config: SimConfig,
    seconds: float,
    tool: tuple[float, float, float] | None = None,
    settle: float = 0.0,
) -> Run:
    """Guide the robot and record it, optionally after a tool change and some time to settle."""
    assert robot.calibration is not None
    truth = TrueRobot.draw(robot, config)
    readings, fixes, visible = [], [], []
    with Physics(truth, robot.calibration, config) as physics:
        if tool is not None:
            physics.change_tool(np.array(tool))
        reading_steps = physics.rate_hz // config.encoders.rate_hz
        frame_steps = physics.rate_hz // config.camera.rate_hz
        q = np.zeros(len(robot.joints))
        while physics.steps < (seconds + settle) * physics.rate_hz:
            physics.step()
            if physics.steps % reading_steps == 0:
                q = physics.read_encoders()
            if physics.steps % frame_steps == 0 and physics.steps > settle * physics.rate_hz:
                scene = physics.scene()
                readings.append(q)
                fixes.append(in_eye(scene))
                visible.append(bool(physics.sight.visible((scene.angles + truth.offsets)[None])[0]))
    return Run(robot, np.array(readings), np.array(fixes), np.array(visible))


class NoRenderer:
    """Replacement of the renderer's process that paints nothing: all images are black."""

    process = SimpleNamespace(poll=lambda: None)

    def __init__(self, *arguments) -> None: ...

    def __enter__(self):
        return self

    def __exit__(self, *error) -> None: ...

    def request(self, number, scene) -> None: ...

    def fetch(self, number, timeout_s):
        return tuple(np.zeros((480, 640, 3), np.uint8) for _ in range(2))


@cache
def shipped_run(seed: int) -> Run:
    """Return twelve seconds of the shipped robot."""
    return guide(shipped(), SimConfig(seed=seed), 12.0)


def step_degrees(run: Run) -> FloatArray:
    """Return the joint-space distance between neighbouring frames [deg]."""
    return np.degrees(np.linalg.norm(np.diff(run.q, axis=0), axis=1))
