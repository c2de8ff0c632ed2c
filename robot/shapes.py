"""Visual shapes of a URDF's links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bodyschema.interfaces.records import FloatArray

from .rpy import pose_of

# Attributes that give the size of each primitive.
_SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}


@dataclass(frozen=True, eq=False)
class Shape:
    """A visual shape of a link."""

    kind: str  # box, sphere, cylinder, capsule or mesh. Cylinders and capsules lie along z.
    sizes: tuple[float, ...]  # edges of a box; radius; radius and length [m]; of a mesh the factors of x, y and z
    T_link_shape: FloatArray  # its pose (4, 4)
    rgba: tuple[float, ...] | None  # its colour; None where the URDF gives none
    mesh: str = ""  # name of the mesh's file in the URDF; empty for other kinds


def link_shapes(root: Any) -> dict[str, list[Shape]]:
    """Return the shapes of all links of a parsed URDF; malformed ones are skipped, since none is required."""
    colours = {material.get("name"): rgba for material in root.iter("material") if (rgba := rgba_of(material))}
    return {
        link.get("name"): [shape for each in link.iterfind("visual") if (shape := _shape(each, colours)) is not None]
        for link in root.iterfind("link")
    }


def _shape(visual: Any, colours: dict[str, tuple[float, ...]]) -> Shape | None:
    geometry, origin, material = visual.find("geometry/*"), visual.find("origin"), visual.find("material")
    place = {} if origin is None else origin.attrib
    xyz, rpy = (floats(place.get(key, "0 0 0"), 3) for key in ("xyz", "rpy"))
    if geometry is None or xyz is None or rpy is None:
        return None
    T = pose_of(np.array(xyz), np.array(rpy))
    rgba = None if material is None else rgba_of(material) or colours.get(material.get("name"))
    if geometry.tag == "mesh":
        scale = floats(geometry.get("scale", "1 1 1"), 3)
        return Shape("mesh", scale, T, rgba, geometry.get("filename", "")) if scale and all(scale) else None
    words = " ".join(geometry.get(key, "") for key in _SIZES.get(geometry.tag, ()))
    sizes = floats(words, {"box": 3, "sphere": 1}.get(geometry.tag, 2))
    return Shape(geometry.tag, sizes, T, rgba) if sizes and min(sizes) > 0.0 else None


def rgba_of(material: Any) -> tuple[float, ...] | None:
    """Return the colour of a <material>, each part from 0 to 1; None if it is missing or malformed."""
    colour = material.find("color")
    values = None if colour is None else floats(colour.get("rgba", ""), 4)
    return None if values is None else tuple(np.clip(values, 0.0, 1.0).tolist())


def floats(text: str | None, count: int) -> tuple[float, ...] | None:
    """Return the `count` finite numbers in a text; None if it contains anything else."""
    try:
        values = tuple(float(word) for word in (text or "").split())
    except ValueError:
        return None
    return values if len(values) == count and bool(np.isfinite(values).all()) else None
