"""The robot, its cameras and its prediction beside the markers of a recording, for the Rerun viewer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bodyschema.diagnosis.fit.alignment import aligned
from bodyschema.diagnosis.fit.observations import Observations
from bodyschema.effects import Motion, Simulation, load_simulation
from bodyschema.effects.exports.arm_errors import geometry_of
from bodyschema.effects.exports.link_parts import LinkParts
from bodyschema.recordings.files import RERUN, of_robot
from bodyschema.recordings.recording import Recording
from bodyschema.recordings.rerun_export import LinkMesh, Scene


def scene_for(out: Path, robot: Path, recording: Recording) -> Scene | None:
    """Return the scene of a recording by a robot.toml or extended.toml; None if `out` cannot hold one.

    Raises:
        ConfigError, RobotError: the robot's file is missing or wrong.
        RecordingError: the recording is of other joints.
    """
    if out.suffix.lower() != RERUN:
        return None
    simulation = load_simulation(robot)
    return scene_of(simulation, of_robot(recording, simulation.robot.joints, recording.file or out))


def scene_of(simulation: Simulation, recording: Recording) -> Scene:
    """Return the scene of a recording; poses of camera and marker unknown to robot.toml are fitted to it."""
    motion = Motion.of(recording)
    if not simulation.all_effects:
        simulation = aligned(Observations.of(recording, simulation), simulation).simulation.placed
    predicted, robot = simulation.positions(motion), simulation.placed.robot
    geometry = geometry_of(simulation.placed)
    joints = {
        name: replace(joint, T_parent_joint=geometry.T_parent_joint.get(name, joint.T_parent_joint))
        for name, joint in robot.tree.joints.items()
    }
    robot = replace(robot, tree=replace(robot.tree, joints=joints))
    placed = robot.with_placement(geometry.T_parent_camera, geometry.marker_xyz)
    return Scene(placed, predicted, _meshes(robot.tree.file))


def _meshes(urdf: Path) -> dict[str, list[LinkMesh]]:
    found: dict[str, list[LinkMesh]] = {}
    parts = LinkParts.of(urdf, urdf.parent)
    meshes = {mesh["name"]: mesh for mesh in parts.meshes}
    for link, geoms in parts.geoms.items():
        for geom in (geom for geom in geoms if geom["type"] == "mesh"):
            mesh, (w, x, y, z) = meshes[geom["mesh"]], _numbers(geom["quat"])
            scale = _numbers(mesh.get("scale", "1 1 1"))
            one = LinkMesh(urdf.parent / mesh["file"], _numbers(geom["pos"]), (x, y, z, w), scale)
            found.setdefault(link, []).append(one)
    return found


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split()))
