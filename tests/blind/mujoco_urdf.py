"""Public URDFs without their geometry, and hinges, links and masses added to them."""

from __future__ import annotations

import copy
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet_data
from scipy.spatial.transform import Rotation

from .arrays import FloatArray

FLOOR, MOUNT, MARKER = "floor", "mount", "marker_plate"
# A hinge needs some mass behind it; this does not show in any load.
ROTOR_KG, ROTOR_KG_M2 = 1e-6, 1e-9
# A link behind a joint that its URDF gives no mass [kg].
MASSLESS_KG = 0.02
OF_A_GRIPPER = re.compile("finger|grip|jaw|knuckle|thumb", re.IGNORECASE)
EXTENSION = {"fusestatic": "false", "discardvisual": "true", "balanceinertia": "true"}


@dataclass(frozen=True)
class Model:
    """A public arm.

    Attributes:
        file: in pybullet_data, or an absolute path.
        root, hand: link that is bolted down, and link that carries the marker.
        joints: those that are read.
    """

    name: str
    file: str
    root: str
    hand: str
    joints: tuple[str, ...]


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}{k}" for k in range(1, count + 1))


MODELS = (
    Model("iiwa", "kuka_iiwa/model.urdf", "lbr_iiwa_link_0", "lbr_iiwa_link_7", _numbered("lbr_iiwa_joint_", 7)),
    Model("panda", "franka_panda/panda.urdf", "panda_link0", "panda_link8", _numbered("panda_joint", 7)),
    Model("xarm6", "xarm/xarm6_robot.urdf", "link_base", "link6", _numbered("joint", 6)),
)


def longest_arm(file: Path) -> Model:
    """Return the longest chain of turning joints in a URDF, without those of a gripper or behind one that slides."""
    onto = {_ends(joint)[1]: joint for joint in ET.parse(file).getroot().findall("joint")}
    longest: list[ET.Element] = []
    for link in onto:
        chain: list[ET.Element] = []
        while link in onto and onto[link].get("type") != "prismatic":
            if onto[link].get("type") in ("revolute", "continuous"):
                chain.insert(0, onto[link])
            link = _ends(onto[link])[0]
        chain = [joint for joint in chain if not OF_A_GRIPPER.search(joint.get("name", ""))]
        longest = max(longest, chain, key=len)
    return Model(
        file.stem,
        str(file),
        _ends(longest[0])[0],
        _ends(longest[-1])[1],
        tuple(joint.get("name", "") for joint in longest),
    )


class Urdf:
    """A URDF that can be changed.

    Args:
        model: the public arm.
        mount_rpy: orientation of its base on the floor [rad].
    """

    def __init__(self, model: Model, mount_rpy: tuple[float, float, float]) -> None:
        self.model = model
        self.root = ET.parse(Path(pybullet_data.getDataPath()) / model.file).getroot()
        self.root.set("name", model.name)
        self._strip()
        self._add_link(FLOOR)
        self._add_joint(MOUNT, "fixed", FLOOR, model.root, np.zeros(3), np.array(mount_rpy))
        self._add_link(MARKER)
        self._add_joint("marker_mount", "fixed", model.hand, MARKER)

    def copy(self) -> Urdf:
        """Return one that can be changed independently."""
        return copy.deepcopy(self)

    @property
    def text(self) -> str:
        """The URDF as text."""
        ET.indent(self.root)
        return ET.tostring(self.root, encoding="unicode")

    @property
    def text_for_mujoco(self) -> str:
        """The URDF with the compiler options that keep all links apart."""
        root = copy.deepcopy(self.root)
        extension = ET.Element("mujoco")
        ET.SubElement(extension, "compiler", EXTENSION)
        root.insert(0, extension)
        return ET.tostring(root, encoding="unicode")

    @property
    def kilograms(self) -> float:
        """Mass of all links."""
        return sum(float(mass.get("value", "0")) for mass in self.root.iter("mass"))

    def limits(self) -> FloatArray:
        """Return lower and upper limits [rad] of the joints that are read (d, 2)."""
        found = [self._joint(name).find("limit") for name in self.model.joints]
        return np.array(
            [[float(limit.get(end, "0")) for end in ("lower", "upper")] for limit in found if limit is not None]
        )

    def displace(self, joint: str, shift: FloatArray, turn: FloatArray) -> None:
        """Move a joint's frame by a shift [m] and a rotation vector [rad], both (3,) in that frame."""
        place, R = self._origin(joint)
        self._set_origin(joint, place + R.apply(shift), R * Rotation.from_rotvec(turn))

    def add_give(self, joint: str) -> str:
        """Insert a passive hinge about a joint's axis between its motor and its link; return its name."""
        element = self._joint(joint)
        child, axis = _named(element, "child").get("link", ""), self._axis(joint)
        rotor, give = f"{joint}_rotor", f"{joint}_give"
        self._add_link(rotor, ROTOR_KG)
        _named(element, "child").set("link", rotor)
        self._add_joint(give, "continuous", rotor, child, axis=axis)
        return give

    def add_bend(self, joint: str, next_joint: str) -> tuple[str, str]:
        """Cut a joint's link half way to the next joint; two hinges across the link join the halves."""
        element = self._joint(next_joint)
        parent = _named(element, "parent").get("link", "")
        place, R = self._origin(next_joint)
        across = np.linalg.svd(place[None])[2][1:]
        names = (f"{joint}_bend_1", f"{joint}_bend_2")
        self._add_link(f"{joint}_half_1", ROTOR_KG)
        self._add_link(f"{joint}_half_2", ROTOR_KG)
        self._add_joint(names[0], "continuous", parent, f"{joint}_half_1", 0.5 * place, axis=across[0])
        self._add_joint(names[1], "continuous", f"{joint}_half_1", f"{joint}_half_2", axis=across[1])
        _named(element, "parent").set("link", f"{joint}_half_2")
        self._set_origin(next_joint, 0.5 * place, R)
        return names

    def add_tilt(self) -> tuple[str, str]:
        """Put the base on two horizontal hinges of the floor; return their names."""
        place, R = self._origin(MOUNT)
        self._add_link("tilt_link_1", ROTOR_KG)
        self._add_link("tilt_link_2", ROTOR_KG)
        self._add_joint("tilt_1", "continuous", FLOOR, "tilt_link_1", place, axis=np.array([1.0, 0.0, 0.0]))
        self._add_joint("tilt_2", "continuous", "tilt_link_1", "tilt_link_2", axis=np.array([0.0, 1.0, 0.0]))
        _named(self._joint(MOUNT), "parent").set("link", "tilt_link_2")
        self._set_origin(MOUNT, np.zeros(3), R)
        return "tilt_1", "tilt_2"

    def loosen_marker(self, axis: FloatArray, kilograms: float, at: FloatArray) -> str:
        """Hold the marker's plate by a hinge, its mass at `at` (3,) [m]; return its name."""
        element = self._joint("marker_mount")
        element.set("type", "continuous")
        ET.SubElement(element, "axis", {"xyz": _text(axis)})
        self._weigh(self._link(MARKER), kilograms, at)
        return "marker_mount"

    def add_payload(self, kilograms: float, at: FloatArray) -> None:
        """Fix a mass to the hand at `at` (3,) [m] in the hand's frame."""
        self._add_link("payload", kilograms)
        self._add_joint("payload_mount", "fixed", self.model.hand, "payload", at)

    def _strip(self) -> None:
        """Remove all but links, joints and masses; joints that are not read become fixed."""
        for element in list(self.root):
            if element.tag not in ("link", "joint"):
                self.root.remove(element)
            for part in list(element):
                if part.tag not in ("inertial", "parent", "child", "origin", "axis", "limit"):
                    element.remove(part)
        self._keep_below(self.model.root)
        for joint in self.root.findall("joint"):
            if joint.get("name") not in self.model.joints:
                joint.set("type", "fixed")
                continue
            joint.set("type", "revolute")
            _limit(joint)
            link = self._link(_ends(joint)[1])
            mass, inertial = link.find("inertial/mass"), link.find("inertial")
            if mass is None or float(mass.get("value", "0")) <= 0.0:
                if inertial is not None:
                    link.remove(inertial)
                self._weigh(link, MASSLESS_KG, np.zeros(3))

    def _keep_below(self, root: str) -> None:
        """Remove what a link does not carry."""
        kept, onto = {root}, {joint: _ends(joint) for joint in self.root.findall("joint")}
        while below := {child for parent, child in onto.values() if parent in kept} - kept:
            kept |= below
        for link in self.root.findall("link"):
            if link.get("name") not in kept:
                self.root.remove(link)
        for joint, (parent, _) in onto.items():
            if parent not in kept:
                self.root.remove(joint)

    def _link(self, name: str) -> ET.Element:
        return next(link for link in self.root.findall("link") if link.get("name") == name)

    def _joint(self, name: str) -> ET.Element:
        return next(joint for joint in self.root.findall("joint") if joint.get("name") == name)

    def _axis(self, joint: str) -> FloatArray:
        axis = self._joint(joint).find("axis")
        return np.array([1.0, 0.0, 0.0]) if axis is None else np.array([float(v) for v in axis.get("xyz", "").split()])

    def _origin(self, joint: str) -> tuple[FloatArray, Rotation]:
        origin = self._joint(joint).find("origin")
        if origin is None:
            return np.zeros(3), Rotation.identity()
        place, rpy = (np.array([float(v) for v in origin.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
        return place, Rotation.from_euler("xyz", rpy)

    def _set_origin(self, joint: str, place: FloatArray, R: Rotation) -> None:
        element = self._joint(joint)
        origin = element.find("origin")
        origin = ET.SubElement(element, "origin") if origin is None else origin
        origin.set("xyz", _text(place))
        origin.set("rpy", _text(R.as_euler("xyz")))

    def _add_link(self, name: str, kilograms: float = 0.0) -> None:
        link = ET.SubElement(self.root, "link", {"name": name})
        if kilograms:
            self._weigh(link, kilograms, np.zeros(3))

    def _weigh(self, link: ET.Element, kilograms: float, at: FloatArray) -> None:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", {"xyz": _text(at), "rpy": "0 0 0"})
        ET.SubElement(inertial, "mass", {"value": repr(float(kilograms))})
        moments = {f"i{a}{b}": "0" for a, b in ("xy", "xz", "yz")}
        size = max(ROTOR_KG_M2, 1e-3 * kilograms if kilograms > ROTOR_KG else 0.0)
        ET.SubElement(inertial, "inertia", moments | dict.fromkeys(("ixx", "iyy", "izz"), repr(size)))

    def _add_joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        place: FloatArray | None = None,
        rpy: FloatArray | None = None,
        axis: FloatArray | None = None,
    ) -> None:
        joint = ET.SubElement(self.root, "joint", {"name": name, "type": kind})
        ET.SubElement(joint, "parent", {"link": parent})
        ET.SubElement(joint, "child", {"link": child})
        origin = {"xyz": np.zeros(3) if place is None else place, "rpy": np.zeros(3) if rpy is None else rpy}
        ET.SubElement(joint, "origin", {key: _text(value) for key, value in origin.items()})
        if axis is not None:
            ET.SubElement(joint, "axis", {"xyz": _text(axis)})


def _named(element: ET.Element, tag: str) -> ET.Element:
    found = element.find(tag)
    assert found is not None
    return found


def _ends(joint: ET.Element) -> tuple[str, str]:
    """Return the names of the links before and behind a joint."""
    return _named(joint, "parent").get("link", ""), _named(joint, "child").get("link", "")


def _limit(joint: ET.Element) -> None:
    """Give a joint that turns without end a limit."""
    limit = joint.find("limit")
    limit = ET.SubElement(joint, "limit", {"effort": "100", "velocity": "3"}) if limit is None else limit
    if float(limit.get("lower", "0")) >= float(limit.get("upper", "0")):
        limit.set("lower", repr(-math.pi))
        limit.set("upper", repr(math.pi))


def _text(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)
