"""Export the simulation as MJCF: a joint's value is its encoder reading, and further joints hold its errors.

| error | in MJCF |
| --- | --- |
| joint offset | `ref` of the joint |
| scale, coupling, periodic errors | a second joint about the same axis, tied to the readings that cause them |
| backlash | a second joint with a range, and friction between the link and its parent |
| compliance | a second joint with a stiffness |
| backlash under gravity | a loose joint with a range, and the friction that was found |
| payload | a body with its mass |
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bodyschema.effects.exports.arm_errors import geometry_without_zeros
from bodyschema.effects.gravity import GRAVITY_M_S2
from bodyschema.effects.joint_errors import JointErrors, Wave
from bodyschema.effects.simulation import Simulation
from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray
from bodyschema.robot.urdf import MOVING, UrdfJoint, fixed_transform

from .arm_errors import ArmErrors, numbers
from .link_parts import LinkParts, PartSettings, placed, rod, texts

MARKER, MEASUREMENT = "marker", "measurement_frame"
LOOSE = "_gravity_backlash"


class _Settings:
    """Settings of the exported file."""

    step_s = 0.001
    # Inertia added to each joint [kg·m²], for joints about one axis in a row; a joint without load needs little.
    armature, idle_armature = 0.05, 1e-6
    # Rates [rad/s] of actuators and of unloaded springs: well below 1/step_s, so that the integrator follows.
    servo_rate, spring_rate = 100.0, 60.0
    # Friction as a multiple of gravity's largest torque: backlash shows only if the weight does not close it.
    friction_margin, min_friction = 2.0, 0.1
    postures = 256  # in which that torque is sought
    # The distance of a point this far [m] from a circle of this radius [m] is a sine of the angle, to 1 in 2,000.
    wave_anchor, wave_radius = 1.0, 0.001


# Constraint settings that yield by less than 1e-4 of the load.
_STIFF = {"solref": f"{4 * _Settings.step_s:g} 1", "solimp": "0.9999 0.9999 0.001 0.5 2"}
_HIDDEN, _WORLD = "5", "world"


def write_mjcf(simulation: Simulation, file: Path, heading: str) -> list[str]:
    """Write the simulation as MJCF to `file`.

    Returns:
        Sentences on effects that the file does not hold, or holds in another form.

    Raises:
        RobotError: two joints would have the same name.
        OSError: the file cannot be written.
    """
    document = _Document(simulation, file.parent)
    summary = document.summary
    file.write_bytes(document.written([heading, *summary]))
    return summary


@dataclass
class _Document:
    """Builder of one MJCF file."""

    simulation: Simulation  # the simulation to export
    folder: Path  # folder of the file
    joints: set[str] = field(default_factory=set)  # names of the joints in it

    def __post_init__(self) -> None:
        from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

        self._etree = etree
        robot = self.simulation.robot
        self._robot, self._tree = robot, robot.tree
        self._errors = ArmErrors.of(self.simulation)
        self._parts = LinkParts.of(robot.tree.file, self.folder)
        self._geometry = geometry_without_zeros(self._errors.simulation)  # offsets go into `ref`
        self._root = etree.Element("mujoco", model=robot.name)
        self._settings()
        self._asset = self._add(self._root, "asset")
        self._world = self._add(self._root, "worldbody")
        self._tendon, self._equality, self._actuator, self._custom = (
            self._add(self._root, tag) for tag in ("tendon", "equality", "actuator", "custom")
        )
        sky = {"builtin": "gradient", "rgb1": "0.9 0.92 0.95", "rgb2": "0.6 0.65 0.7", "width": "64", "height": "384"}
        self._add(self._asset, "texture", type="skybox", **sky)
        for mesh in self._parts.meshes:
            self._add(self._asset, "mesh", **mesh)
        self._add(self._world, "light", pos="0 0 3", dir="0 0 -1", directional="true")
        children = {joint.child for joint in self._tree.joints.values()}
        base = next(link for link in self._tree.links if link not in children)
        self._link(self._world, base, np.eye(4), None)
        self._note_left_out()

    @property
    def summary(self) -> list[str]:
        summary = self._errors.summary()
        if self._parts.unreadable:
            some = ", ".join(self._parts.unreadable[:3]) + (", ..." if len(self._parts.unreadable) > 3 else "")
            summary.append(
                f"not in the file: {len(self._parts.unreadable)} meshes ({some}): missing, or not STL or OBJ"
            )
        if not self.simulation.gravity.known:
            summary.append(
                "the URDF states no masses: those of the file are placeholders, so its dynamics mean nothing"
            )
        return summary

    def written(self, summary: list[str]) -> bytes:
        """Return the file's content, with sentences at its top."""
        etree = self._etree
        lines = [
            *summary,
            "The value of each joint is what its encoder reads. Positions of the measurement are those of the site "
            f"{MARKER} in the frame of the site {MEASUREMENT}.",
            "At rest the arm stands as found. Armature, damping, gains and friction were chosen, not measured.",
        ]
        text = "\n".join(lines)
        # XML comments must not contain two in a row
        self._root.insert(0, etree.Comment(re.sub("-(?=-)", "- ", f"\n{text}\n")))
        for group in (self._tendon, self._equality, self._actuator, self._custom):
            if not len(group):
                self._root.remove(group)
        etree.indent(self._root, space="  ")
        return etree.tostring(self._root, encoding="utf-8", xml_declaration=True, pretty_print=True)

    def _add(self, parent: Any, tag: str, /, **attributes: str) -> Any:
        return self._etree.SubElement(parent, tag, attributes)

    def _settings(self) -> None:
        self._add(
            self._root,
            "compiler",
            angle="radian",
            inertiafromgeom="false",
            balanceinertia="true",
            boundmass="1e-6",
            boundinertia=f"{PartSettings.min_inertia_kgm2:g}",
        )
        gravity = texts(np.array([0.0, 0.0, -GRAVITY_M_S2]))
        self._add(self._root, "option", timestep=f"{_Settings.step_s:g}", integrator="implicitfast", gravity=gravity)
        default = self._add(self._root, "default")
        self._add(default, "geom", contype="0", conaffinity="0", group="2")
        self._add(default, "joint", armature=f"{_Settings.armature:g}")
        self._add(default, "equality", **_STIFF)
        self._add(default, "tendon", group=_HIDDEN)

    def _link(self, parent: Any, link: str, T: FloatArray, above: UrdfJoint | None) -> None:
        """Add a link at the pose T (4, 4) in `parent`, and everything attached to it."""
        # MuJoCo reserves the name of the world.
        is_world = link == _WORLD and parent is self._world
        body = parent if is_world else self._add(parent, "body", name=link, **placed(T))
        mass = self._tree.masses.get(link)
        if mass is not None and mass.mass_kg > 0.0 and not is_world:
            inertia = self._parts.inertias.get(link, np.zeros((3, 3)))
            full = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            self._add(body, "inertial", pos=texts(mass.centre), mass=repr(mass.mass_kg), fullinertia=texts(full))
        if above is not None:
            self._joints(body, above)
        below = [joint for joint in self._tree.joints.values() if joint.parent == link]
        poses = [self._geometry.T_parent_joint.get(joint.name, joint.T_parent_joint) for joint in below]
        for geom in self._parts.geoms.get(link) or filter(None, (rod(T_child[:3, 3]) for T_child in poses)):
            self._add(body, "geom", **geom)
        self._frames(body, link)
        for joint, T_child in zip(below, poses, strict=True):
            if self._moves(joint):
                self._link(body, joint.child, T_child, joint)
            else:
                held = self._robot.robot.held_at.get(joint.name, 0.0)
                self._link(body, joint.child, fixed_transform(joint, False, held), None)

    def _payloads(self, body: Any) -> None:
        for count, payload in enumerate(self._errors.payloads):
            held = self._add(body, "body", name=f"{self._robot.robot.marker_link}_payload_{count}")
            centre, inertia = texts(payload.centre), texts(np.full(3, PartSettings.min_inertia_kgm2))
            self._add(held, "inertial", pos=centre, mass=repr(payload.mass_kg), diaginertia=inertia)

    def _moves(self, joint: UrdfJoint) -> bool:
        """Return True if a joint moves in the file: joints held by robot.toml are fixed."""
        name, robot = joint.name, self._robot
        return joint.kind in MOVING and (name in robot.joints or name not in robot.robot.held_at)

    def _frames(self, body: Any, link: str) -> None:
        if link == self._robot.robot.marker_link:
            self._add(body, "site", name=MARKER, pos=texts(self._geometry.marker_xyz), size="0.01", rgba="1 0.4 0 1")
            self._payloads(body)
        if link != self._robot.camera.parent_link:
            return
        T = self._geometry.T_parent_camera
        self._add(body, "site", name=MEASUREMENT, size="0.01", rgba="0 0.4 1 1", **placed(T))
        camera = self._robot.camera
        if camera.focal_px is None or camera.image_size_px is None or camera.principal_point_px is None:
            return
        size = np.array(camera.image_size_px, dtype=np.float64)
        # MuJoCo's cameras look along -z; their principal point counts from the centre, to the right and up.
        centre = (np.array(camera.principal_point_px) - 0.5 * size) * [1.0, -1.0]
        self._add(
            body,
            "camera",
            name="camera",
            **placed(T @ np.diag([1.0, -1.0, -1.0, 1.0])),
            resolution=f"{camera.image_size_px[0]} {camera.image_size_px[1]}",
            sensorsize=texts(size * 1e-5),
            focalpixel=texts(np.full(2, camera.focal_px)),
            principalpixel=texts(centre),
        )

    def _joints(self, body: Any, joint: UrdfJoint) -> None:
        """Add the joint that is read, then those that hold its errors."""
        errors = self._errors.joints.get(joint.name, JointErrors())
        kind = {"type": "slide" if joint.kind == "prismatic" else "hinge", "axis": texts(joint.axis)}
        limits = {} if joint.kind == "continuous" else {"range": texts(np.array([joint.lower, joint.upper]))}
        zero = {"ref": repr(-errors.offset)} if errors.offset else {}
        inertia = self._inertia(joint) + _Settings.armature
        # MuJoCo's friction and limits soften with lighter joints in the chain; a backlash needs hard ones.
        heavy = {"armature": f"{inertia:.4g}"} if errors.play else {}
        self._joint(body, joint.name, **kind, **limits, **zero, **heavy)
        gain = f"{_Settings.servo_rate**2 * inertia:.4g}"
        if (mimic := self._parts.mimics.get(joint.name)) and self._moves(self._tree.joint(mimic[0])):
            self._tie(joint.name, *mimic)
        else:
            self._add(
                self._actuator,
                "position",
                name=joint.name,
                joint=joint.name,
                kp=gain,
                dampratio="1",
                **({"ctrlrange": limits["range"]} if limits else {}),
            )
        if errors.ratios or errors.waves:
            name = f"{joint.name}_error"
            self._joint(body, name, **kind, **heavy)
            self._tie_error(name, joint, errors)
        if errors.play:
            self._play(body, joint, kind | heavy, errors.play)
        if errors.loose:
            width, friction = errors.loose
            held = {f"{key}{of}": value for key, value in _STIFF.items() for of in ("limit", "friction")}
            reach = texts(np.array([-0.5 * width, 0.5 * width]))
            name = f"{joint.name}{LOOSE}"
            self._joint(body, name, **kind, **held, range=reach, frictionloss=repr(friction), armature=f"{inertia:.4g}")
        if errors.compliance:
            stiffness = 1.0 / errors.compliance
            armature = stiffness / _Settings.spring_rate**2
            damping = 2.0 * np.sqrt(stiffness * (armature + inertia))
            spring = {"stiffness": repr(stiffness), "damping": f"{damping:.4g}", "armature": f"{armature:.4g}"}
            self._joint(body, f"{joint.name}_spring", **kind, **spring)

    def _joint(self, body: Any, name: str, **attributes: str) -> None:
        if name in self.joints:
            raise RobotError(f"two joints would be called {name!r}", file=self._tree.file, remedy="Rename it there")
        self.joints.add(name)
        self._add(body, "joint", name=name, **attributes)

    def _tie(self, name: str, source: str, factor: float, offset: float = 0.0) -> None:
        """Tie a joint to offset + factor · (reading of another)."""
        errors = self._errors.joints.get(source, JointErrors())
        # MuJoCo counts the reading from the joint's initial value in the file, which is -offset.
        at_rest = offset - factor * errors.offset
        polynomial = texts(np.array([at_rest, factor, 0.0, 0.0, 0.0]))
        self._add(self._equality, "joint", joint1=name, joint2=source, polycoef=polynomial)

    def _tie_error(self, name: str, joint: UrdfJoint, errors: JointErrors) -> None:
        """Tie the joint `name` to the readings: its value minus a share of each is the sum of the periodic errors."""
        rest = self._add(self._tendon, "fixed", name=name)
        self._add(rest, "joint", joint=name, coef="1")
        constant, factor, ends = 0.0, 0.0, {"tendon1": name}
        for source, ratio in errors.ratios.items():
            self._add(rest, "joint", joint=source, coef=repr(-ratio))
            # MuJoCo counts the reading from the joint's initial value in the file, which is minus its offset.
            constant -= ratio * self._errors.joints[source].offset
        if errors.waves:
            # The largest error has the largest hand.
            scale = _Settings.wave_radius / max(wave.amplitude for wave in errors.waves)
            factor, ends["tendon2"] = -1.0 / scale, f"{name}_waves"
            constant += factor * self._wave_dials(f"{name}_waves", joint, errors.waves, scale)
        polynomial = texts(np.array([constant, factor, 0.0, 0.0, 0.0]))
        self._add(self._equality, "tendon", polycoef=polynomial, **ends)

    def _wave_dials(self, name: str, joint: UrdfJoint, waves: list[Wave], scale: float) -> float:
        """Add a tendon from a fixed point to one hand for each periodic error, which turns with the reading.

        The distance from (a, 0) to r · (cos, sin) of an angle is a - r · cos to first order in r/a.

        Returns:
            Its length minus the distances to the hands' axes [m], at the joint's initial value in the file.
        """
        still, length, longer = self._wave_base(), self._add(self._tendon, "spatial", name=name), 0.0
        for count, wave in enumerate(waves):
            dial, radius = f"{name}_{count}", scale * wave.amplitude
            turning = self._add(still, "body", name=dial)
            self._joint(turning, dial, type="hinge", axis="0 0 1", armature=f"{_Settings.idle_armature:g}")
            hand = radius * np.array([np.cos(wave.phase), -np.sin(wave.phase), 0.0])
            self._add(turning, "site", name=dial, pos=texts(hand), group=_HIDDEN)
            self._tie(dial, joint.name, wave.frequency)
            if count:
                self._add(length, "pulley", divisor="1")
            for site in ("wave_anchor", dial):
                self._add(length, "site", site=site)
            longer += float(np.hypot(_Settings.wave_anchor - hand[0], hand[1])) - _Settings.wave_anchor
        return longer

    def _wave_base(self) -> Any:
        """Return the body of the points that turn with readings."""
        still = self._world.find("body[@name='periodic_errors']")
        if still is None:
            still = self._add(self._world, "body", name="periodic_errors")
            place = texts(np.array([_Settings.wave_anchor, 0, 0]))
            self._add(still, "site", name="wave_anchor", pos=place, group=_HIDDEN)
        return still

    def _play(self, body: Any, joint: UrdfJoint, kind: dict[str, str], width: float) -> None:
        """Add a joint that is loose over the width of the backlash, with friction that keeps the link in place."""
        name = f"{joint.name}_backlash"
        stiff = {f"{key}limit": value for key, value in _STIFF.items()}
        reach = texts(np.array([-0.5 * width, 0.5 * width]))
        self._joint(body, name, **kind, range=reach, **stiff)
        torque = self._largest_torques[self._robot.joints.index(joint.name)]
        friction = max(_Settings.friction_margin * float(torque), _Settings.min_friction)
        held = {f"{key}friction": value for key, value in _STIFF.items()}
        output = self._add(self._tendon, "fixed", name=name, frictionloss=f"{friction:.4g}", **held)
        for part in (joint.name, name):
            self._add(output, "joint", joint=part, coef="1")

    @cached_property
    def _largest_torques(self) -> FloatArray:
        """Return gravity's largest torque or force (d,) about each joint that is read, over its range."""
        lower, upper = np.maximum(self._robot.lower, -np.pi), np.minimum(self._robot.upper, np.pi)
        q = np.random.default_rng(0).uniform(lower, upper, (_Settings.postures, len(lower)))
        return np.abs(self.simulation.torques(q)).max(axis=0)

    def _inertia(self, joint: UrdfJoint) -> float:
        """Return the inertia about a joint, of point masses at zero [kg·m²]; for a prismatic joint the mass [kg]."""
        total, ends = 0.0, [(joint.child, np.eye(4))]
        for link, T in ends:  # grows during the loop
            mass = self._tree.masses.get(link)
            if mass is not None:
                arm = np.cross(joint.axis, T[:3, :3] @ mass.centre + T[:3, 3])
                total += mass.mass_kg * (1.0 if joint.kind == "prismatic" else float(arm @ arm))
            below = (other for other in self._tree.joints.values() if other.parent == link)
            ends += [(other.child, T @ other.T_parent_joint) for other in below]
        return total

    def _note_left_out(self) -> None:
        """Store the numbers of effects that the file cannot hold, for programs that know them."""
        for count, left_out in enumerate(self._errors.left_out):
            effect = left_out.effect
            name = f"{'_'.join(filter(None, effect.key))}_{count}"
            self._add(self._custom, "numeric", name=name, data=texts(effect.values))
            self._add(self._custom, "text", name=name, data=numbers(effect))
