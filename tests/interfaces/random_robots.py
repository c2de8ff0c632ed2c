"""Random robots on disk: trees with a camera branch and an arm, fixed and standing joints between, and beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bodyschema.robot.description import RobotDescription

MESH = '<visual><geometry><mesh filename="meshes/{}.stl" scale="1 1 1"/></geometry></visual>'
INERTIAL = '<inertial><mass value="0.7"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


def random_robot(rng: np.random.Generator, folder: Path, *, head: str, arm: str) -> RobotDescription:
    """Return a robot whose joints from camera to marker are `head` (walked from link to parent) and then `arm`.

    Letters: R revolute, P prismatic, F fixed, H one that stands still at a place of robot.toml's.
    """
    body, held = ['<link name="base">' + MESH.format("base") + INERTIAL + "</link>"], {}
    ends, learnt = [], {}
    for branch, kinds in (("head", head), ("arm", arm)):
        parent, learnt[branch] = "base", []
        for k, kind in enumerate(kinds[::-1] if branch == "head" else kinds):
            name = f"{branch}_{k}"
            body += [_link(rng, f"{name}_link"), _joint(rng, name, kind, parent, f"{name}_link")]
            if kind in "RP":
                learnt[branch].append(name)
            if kind == "H":
                held[name] = float(rng.uniform(-1, 1))
            parent = f"{name}_link"
        ends.append(parent)
    body += [_link(rng, "aside"), _joint(rng, "aside_joint", "R", ends[1], "aside")]
    (folder / "robot.urdf").write_text(f'<?xml version="1.0"?>\n<robot name="r"><!-- kept -->{"".join(body)}</robot>')
    joints = [*reversed(learnt["head"]), *learnt["arm"]]
    (folder / "robot.toml").write_text(
        f'[robot]\nname = "r"\nurdf = "robot.urdf"\njoints = {joints}\nmarker_link = "{ends[1]}"\n'
        f"marker_xyz = {rng.normal(0, 0.1, 3).tolist()}\n"
        f"held_at = {{{', '.join(f'{name} = {value!r}' for name, value in held.items())}}}\n"
        f'[camera]\nparent_link = "{ends[0]}"\nxyz = {rng.normal(0, 0.3, 3).tolist()}\n'
        f"rpy = {rng.uniform(-3, 3, 3).tolist()}\npose_known = false\n"
        '[daemon]\nstate_dir = "state"\n[drivers]\nrecording = "pairs.csv"\n[sim]\nseed = 5\n'
        "[[sim.tool_changes]]\nat_s = 1.5\nmarker_xyz = [0.0, 0.0, 0.1]\n"
    )
    return RobotDescription.load(folder / "robot.toml")


def _link(rng: np.random.Generator, name: str) -> str:
    return f'<link name="{name}">{MESH.format(name) if rng.random() < 0.5 else INERTIAL}</link>'


def _joint(rng: np.random.Generator, name: str, kind: str, parent: str, child: str) -> str:
    kinds = {"R": "revolute", "P": "prismatic", "F": "fixed", "H": rng.choice(["revolute", "prismatic"])}
    numbers = " ".join(map(repr, rng.normal(0, 0.2, 3).tolist()))
    turn = " ".join(map(repr, rng.uniform(-3, 3, 3).tolist()))
    origin = "" if rng.random() < 0.2 else f'<origin xyz="{numbers}" rpy="{turn}"/>'
    axis = " ".join(map(repr, rng.normal(0, 1, 3).tolist()))
    moving = "" if kind == "F" else f'<axis xyz="{axis}"/><limit lower="-2" upper="2.5" effort="7" velocity="3"/>'
    return (
        f'<joint name="{name}" type="{kinds[kind]}"><parent link="{parent}"/><child link="{child}"/>'
        f"{origin}{moving}</joint>"
    )
