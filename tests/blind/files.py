"""robot.toml and recordings, written out plainly."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .arms import Arm, urdf
from .arrays import FloatArray, IntArray

CONFIG = """\
[robot]
name = "{name}"
urdf = "arm.urdf"
joints = [{joints}]
marker_link = "{marker_link}"
marker_xyz = {marker_xyz}
marker_known = {marker_known}
hold = "{hold}"

[camera]
parent_link = "{camera_link}"
xyz = {xyz}
rpy = {rpy}
pose_known = {pose_known}
focal_px = {eyes.focal_px!r}
principal_point_px = {principal_point}
baseline_m = {eyes.baseline_m!r}
image_size_px = {image_size}
pixel_sigma = {eyes.pixel_sigma!r}
"""
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def write_robot(folder: Path, arm: Arm, hold: str, *, marker_known: bool, pose_known: bool) -> Path:
    """Write robot.toml and arm.urdf of the arm as described; return the path of robot.toml."""
    text = CONFIG.format(
        name=arm.name,
        joints=", ".join(f'"{name}"' for name in arm.read),
        marker_link=arm.marker_link,
        marker_xyz=list(arm.marker_xyz),
        marker_known=str(marker_known).lower(),
        hold=hold,
        camera_link=arm.camera_link,
        xyz=list(arm.camera_xyz),
        rpy=list(arm.camera_rpy),
        pose_known=str(pose_known).lower(),
        eyes=arm.eyes,
        principal_point=list(arm.eyes.principal_point_px),
        image_size=list(arm.eyes.image_size_px),
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(urdf(arm), encoding="utf-8")
    (folder / "robot.toml").write_text(text, encoding="utf-8")
    return folder / "robot.toml"


def write_recording(
    file: Path,
    joints: tuple[str, ...],
    t: FloatArray | None,
    segment: IntArray | None,
    q: FloatArray,
    x: FloatArray,
    covariance: FloatArray | None,
) -> None:
    """Write a recording as CSV with all digits; columns whose values are None are left out."""
    names = [*joints, "x", "y", "z"]
    columns: list[list[float] | list[int]] = [*q.T.tolist(), *x.T.tolist()]
    if t is not None:
        names.insert(0, "t")
        columns.insert(0, t.tolist())
    if covariance is not None:
        names += ["c" + "xyz"[i] + "xyz"[j] for i, j in UPPER]
        columns += [covariance[:, i, j].tolist() for i, j in UPPER]
    if segment is not None:
        names.append("segment")
        columns.append(np.asarray(segment).tolist())
    rows = (",".join(map(repr, row)) for row in zip(*columns, strict=True))
    file.write_text("\n".join([",".join(names), *rows, ""]), encoding="utf-8")
