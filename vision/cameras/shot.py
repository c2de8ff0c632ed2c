"""One image of one camera, with its time."""

from __future__ import annotations

from dataclasses import dataclass

from bodyschema.interfaces.records import ImageArray


@dataclass(frozen=True, slots=True)
class Shot:
    """An image and when it was taken."""

    t: float  # time stamp [s], the latency not yet taken off
    t_sigma: float  # 1-sigma of it [s]
    image: ImageArray  # (height, width, 3), uint8, BGR
