"""Printed pages, read back from the numbers in their files."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from bodyschema.interfaces.records import FloatArray, ImageArray

PX_A_MM = 4


def from_pdf(data: bytes) -> tuple[tuple[float, float], FloatArray]:
    """Return the sheet and its black rectangles (x, y, width, height) from its upper left corner [mm]."""
    mm = 25.4 / 72
    text = data.decode("latin-1")
    box = re.search(r"MediaBox\[0 0 ([\d.]+) ([\d.]+)\]", text)
    sheet = float(box[1]) * mm, float(box[2]) * mm
    found = np.array(re.findall(r"^([-\d.]+) ([-\d.]+) ([\d.]+) ([\d.]+) re$", text, re.MULTILINE), dtype=float) * mm
    found[:, 1] = sheet[1] - found[:, 1] - found[:, 3]
    return sheet, found


def from_svg(data: bytes) -> tuple[tuple[float, float], FloatArray]:
    root = ElementTree.fromstring(data)
    assert root.attrib["viewBox"].split()[2:] == [root.attrib[side].removesuffix("mm") for side in ("width", "height")]
    rects = root.findall("{http://www.w3.org/2000/svg}g/{http://www.w3.org/2000/svg}rect")
    return (
        (float(root.attrib["width"].removesuffix("mm")), float(root.attrib["height"].removesuffix("mm"))),
        np.array([[float(rect.attrib[name]) for name in ("x", "y", "width", "height")] for rect in rects]),
    )


def rasterised(sheet: tuple[float, float], black: FloatArray) -> ImageArray:
    """Return the page as an image, at `PX_A_MM`; pixel k covers k to k + 1."""
    image = np.full((round(sheet[1] * PX_A_MM), round(sheet[0] * PX_A_MM)), 255, np.uint8)
    for x, y, w, h in black * PX_A_MM:
        image[round(y) : round(y + h), round(x) : round(x + w)] = 0
    return image
