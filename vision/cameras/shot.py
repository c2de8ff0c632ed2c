"""One image of one camera, with its time."""

from __future__ import annotations

from dataclasses import dataclass

from bodyschema.interfaces.records import ImageArray


@dataclass(frozen=True, slots=True)
class Shot:
    """An image and when it was taken.

    Attributes:
        t: time stamp [s], the latency not yet taken off.
        t_sigma: 1-sigma of it [s].
        image: (height, width, 3), uint8, BGR.
    """

    t: float
    t_sigma: float
    image: ImageArray
