"""A recording for the Rerun viewer. Needs the extra `rerun`.

| entity | archetype | content |
| --- | --- | --- |
| /robot/<link> | Transform3D, LineStrips3D | the link at the row's readings, in the root link's frame |
| /robot/<link>/mesh_<number> | Asset3D, Transform3D | the meshes of the link that were found |
| /measurement_frame | ViewCoordinates, Transform3D | x right, y down, z forward; its pose on the robot |
| /measurement_frame/left, right | Pinhole | the cameras of robot.toml |
| /measurement_frame/marker | Points3D | the marker of the row, and its Transform3D if it has an orientation |
| /measurement_frame/predicted | Points3D | the marker predicted by the robot's description |
| /measurement_frame/path | LineStrips3D | all positions, a strip for each segment; on no timeline |
| /joints/<name> | Scalars | the joint's angle [rad], or position [m] of a prismatic joint |

Timelines: `pair`, counted from 1, and `time` [s], which is `Recording.play_times`. Without a robot there are no links,
no cameras and no prediction.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.interfaces.errors import RecordingError
from bodyschema.interfaces.records import FloatArray
from bodyschema.recordings.parquet_file import imported
from bodyschema.recordings.recording import Recording
from bodyschema.robot.description import RobotDescription, link_poses
from kbmaps.rotations import quaternions

FRAME, JOINTS, ROBOT = "measurement_frame", "joints", "robot"
RADIUS_M = 0.004
_GREY, _ORANGE = 0x96969BFF, 0xF08C1EFF


@dataclass(frozen=True)
class LinkMesh:
    """A mesh, with its place in its link [m], its orientation (x, y, z, w), and its scale along each axis."""

    file: Path
    place: tuple[float, ...]
    quaternion: tuple[float, ...]
    scale: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """The surroundings of a recording's markers."""

    robot: RobotDescription  # the description, with camera and marker where they are
    predicted: FloatArray  # the marker positions that it predicts in the measurement frame (n, 3) [m]
    meshes: Mapping[str, Sequence[LinkMesh]] = field(default_factory=dict)  # of the links that have any (STL, OBJ)


def write_rerun(recording: Recording, file: Path, scene: Scene | None = None) -> None:
    """Write `recording` to `file`, with the robot and the cameras of `scene`.

    Raises:
        RecordingError: the extra `rerun` is not installed, or the file cannot be written.
    """
    rr = imported("rerun", "rerun", "a Rerun file, unlike CSV,", file)
    try:
        file.touch()  # this error names the file; rerun's does not
        stream = rr.RecordingStream("bodyschema")
        stream.save(file, default_blueprint=_layout(scene))
    except RuntimeError as error:
        raise RecordingError(f"cannot be written: {error}", file=file) from error
    stream.log(FRAME, rr.ViewCoordinates.RDF, static=True)
    stream.log(f"{FRAME}/path", rr.LineStrips3D(runs(recording)), static=True)
    rows = [
        rr.TimeColumn("pair", sequence=np.arange(1, len(recording) + 1)),
        rr.TimeColumn("time", duration=recording.play_times),
    ]
    _send_markers(rr, stream, recording, rows)
    if scene is not None:
        _send_scene(rr, stream, recording, scene, rows)
    for name, angles in zip(recording.joints, recording.q.T, strict=True):
        entity = rr.new_entity_path([JOINTS, name])
        stream.send_columns(entity, indexes=rows, columns=rr.Scalars.columns(scalars=np.ascontiguousarray(angles)))
    stream.flush()
    stream.disconnect()


def _send_markers(rr: Any, stream: Any, recording: Recording, rows: list[Any]) -> None:
    entity, n = f"{FRAME}/marker", len(recording)
    if recording.orientation is None:
        points = rr.Points3D.columns(positions=recording.x, radii=np.full(n, RADIUS_M))
    else:
        points = rr.Points3D.columns(positions=np.zeros((n, 3)), radii=np.full(n, RADIUS_M))
        turned = rr.Transform3D.columns(translation=recording.x, quaternion=recording.orientation)
        stream.send_columns(entity, indexes=rows, columns=turned)
    stream.send_columns(entity, indexes=rows, columns=points)


def _send_scene(rr: Any, stream: Any, recording: Recording, scene: Scene, rows: list[Any]) -> None:
    robot = scene.robot
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    poses = link_poses(robot, recording.q)
    for link, ends in _lines(robot).items():
        entity = rr.new_entity_path([ROBOT, link])
        _send_poses(rr, stream, entity, poses[link], rows)
        stream.log(entity, rr.LineStrips3D(ends, colors=_GREY, radii=RADIUS_M), static=True)
        for number, mesh in enumerate(scene.meshes.get(link, ())):
            placed = rr.Transform3D(translation=mesh.place, quaternion=mesh.quaternion, scale=mesh.scale)
            shape = rr.new_entity_path([ROBOT, link, f"mesh_{number}"])
            stream.log(shape, placed, rr.Asset3D(path=mesh.file), static=True)
    _send_poses(rr, stream, FRAME, poses[robot.camera.parent_link] @ robot.camera.pose, rows)
    n = len(recording)
    orange = np.full(n, _ORANGE, dtype=np.uint32)
    predicted = rr.Points3D.columns(positions=scene.predicted, radii=np.full(n, RADIUS_M), colors=orange)
    stream.send_columns(f"{FRAME}/predicted", indexes=rows, columns=predicted)
    eyes = robot.calibration
    if eyes is None:
        return
    for name, place in zip(("left", "right"), eyes.eyes_m, strict=False):
        lens = rr.Pinhole(
            focal_length=eyes.focal_px,
            principal_point=np.array(eyes.principal_point_px) + 0.5,  # in Rerun integers are corners of pixels
            resolution=eyes.image_size_px,
        )
        stream.log(f"{FRAME}/{name}", rr.Transform3D(translation=place), lens, static=True)


def _send_poses(rr: Any, stream: Any, entity: str, poses: FloatArray, rows: list[Any]) -> None:
    """Send poses (n, 4, 4); equal poses are sent once, on no timeline."""
    turns = quaternions(poses[:, :3, :3])
    if (poses == poses[0]).all():
        stream.log(entity, rr.Transform3D(translation=poses[0, :3, 3], quaternion=turns[0]), static=True)
        return
    moved = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=turns)
    stream.send_columns(entity, indexes=rows, columns=moved)


def _lines(robot: RobotDescription) -> dict[str, list[FloatArray]]:
    """Return the lines (2, 3) [m] from the origin of each link to its joints, and to the marker."""
    lines: dict[str, list[FloatArray]] = {link: [] for link in robot.tree.links}
    for joint in robot.tree.joints.values():
        lines[joint.parent].append(np.array([np.zeros(3), joint.T_parent_joint[:3, 3]]))
    lines[robot.robot.marker_link].append(np.array([np.zeros(3), robot.robot.marker_xyz]))
    return lines


def _layout(scene: Scene | None) -> Any:
    """Return the viewer's initial layout: space beside the joints."""
    views = importlib.import_module("rerun.blueprint")
    space = views.Spatial3DView(origin=FRAME if scene is None else "/")
    joints = views.TimeSeriesView(origin=JOINTS)
    return views.Blueprint(views.Horizontal(space, joints, column_shares=[2, 1]), collapse_panels=True)


def runs(recording: Recording) -> list[FloatArray]:
    """Return the positions of each segment, (m, 3) [m]; of all rows if there are no segments."""
    if recording.segment is None:
        return [recording.x]
    return np.split(recording.x, np.flatnonzero(np.diff(recording.segment)) + 1)
