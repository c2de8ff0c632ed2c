"""The demo's folder: a robot.toml of its own with free ports, the robot's URDF, and what the demo leaves behind."""

from __future__ import annotations

import shutil
import socket
from dataclasses import dataclass
from pathlib import Path

from daemon.wiring import demonstration_model
from interfaces.errors import ConfigError

STATE = "state"
# A folder with this file is a demo's, and may be emptied by the next one.
MARK = ".bodyschema-demo"
# Light ones in the neck, strong ones in the shoulder.
SERVOS = {
    "neck_yaw": "XL330-M288",
    "neck_pitch": "XL330-M288",
    "shoulder_flexion": "XM540-W270",
    "shoulder_abduction": "XM540-W270",
    "upperarm_rotation": "XM430-W350",
    "elbow_flexion": "XM430-W350",
    "forearm_rotation": "XM430-W350",
}


@dataclass(frozen=True, slots=True)
class Scene:
    """Where everything of one demo is."""

    folder: Path

    @property
    def robot_file(self) -> Path:
        """The robot's description with the demo's ports and seed."""
        return self.folder / "robot.toml"

    @property
    def log_file(self) -> Path:
        """What the two processes logged."""
        return self.folder / "daemon.log"

    @property
    def store_file(self) -> Path:
        """The sampler's pairs."""
        return self.folder / STATE / "pairs.sqlite"

    @property
    def recording_file(self) -> Path:
        """All accepted pairs."""
        return self.folder / "recording.csv"

    @property
    def first_tool_file(self) -> Path:
        """The pairs with the first tool alone, which one model can explain."""
        return self.folder / "first_tool.csv"

    @property
    def curve_file(self) -> Path:
        """The learning curve as numbers."""
        return self.folder / "learning_curve.csv"

    @property
    def plot_file(self) -> Path:
        """The learning curve as a picture."""
        return self.folder / "learning_curve.png"


def prepare(folder: Path, seed: int, *, servos: bool = False) -> Scene:
    """Lay out the demo's folder; what an earlier demo left there is replaced.

    Args:
        servos: the joints are Dynamixel servos on a bench.

    Raises:
        ConfigError: the folder is neither empty nor a demo's, or cannot be written.
    """
    model = demonstration_model()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted(path.name for path in folder.iterdir())
        if found and MARK not in found:
            raise ConfigError(f"holds {found[0]!r}, and no demo was here", file=folder, remedy="Give another --out")
        for path in list(folder.iterdir()):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        (folder / MARK).touch()
        for path in model.parent.iterdir():
            if path.suffix in {".urdf", ".toml"}:
                shutil.copyfile(path, folder / path.name)
        scene = Scene(folder.resolve())
        scene.robot_file.write_text(model.read_text(encoding="utf-8") + _own_tables(seed, servos), encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"cannot be written: {error.strerror}", file=folder, remedy="Give another --out or free some space"
        ) from error
    return scene


def _own_tables(seed: int, servos: bool) -> str:
    sampler, learner = _free_ports(2)
    bench = f"servo_bench = true\n{_servos()}" if servos else ""
    return f"""
[zenoh]
sampler = "tcp/127.0.0.1:{sampler}"
learner = "tcp/127.0.0.1:{learner}"

[daemon]
state_dir = "{STATE}"

[sim]
seed = {seed}
{bench}"""


def _servos() -> str:
    """The arm as one would build it of servos."""
    lines = ["", "[drivers.dynamixel.buses.arm]", 'port = "bus"']
    for id, (joint, model) in enumerate(SERVOS.items(), 1):
        lines += ["", "[[drivers.dynamixel.servos]]", f'joint = "{joint}"', f"id = {id}", f'model = "{model}"']
    return "\n".join(lines) + "\n"


def _free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [server.getsockname()[1] for server in sockets]
    for server in sockets:
        server.close()
    return ports
