"""The tables [vision.tag] and [vision.cluster] of robot.toml."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bodyschema.robot.toml_file import Positive

# Of six by six modules: what is between the black borders. All are in every OpenCV from 4.11 on.
Dictionary = Literal[
    "apriltag_36h11", "aruco_6x6_50", "aruco_6x6_100", "aruco_6x6_250", "aruco_6x6_1000", "aruco_mip_36h12"
]
Vector = tuple[float, float, float]


class TagConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.tag]: the tag, or the properties common to all tags of a cluster.

    Attributes:
        dictionary: family of the tags.
        id: number of the tag, if there is a single one.
        side_m: side of its black square as printed [m]: measure it.
        side_sigma_m: 1-sigma of that measurement [m]: a caliper on printed edges. One camera derives all distances from
            it.
    """

    dictionary: Dictionary = "apriltag_36h11"
    id: Annotated[int, Meta(ge=0)] = 0
    side_m: Positive = 0.04
    side_sigma_m: Annotated[float, Meta(ge=0)] = 0.0001


class PlacedTag(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One of [[vision.cluster.tags]]: a tag on the marker.

    Attributes:
        id: its number.
        xyz: its centre in the marker's frame [m].
        rpy: rotation of its frame (x right, y up, z out of it) in the marker's [rad], URDF convention.
        side_m: side of its black square [m], if it differs from that of [vision.tag].
    """

    id: Annotated[int, Meta(ge=0)]
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    side_m: Positive | None = None


class ClusterConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.cluster]: several tags on one rigid body."""

    tags: tuple[PlacedTag, ...] = ()


class ChessboardConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The table [vision.chessboard]: a plain chessboard, whose upper left square is black. Its frame is in its middle.

    Attributes:
        columns, rows: number of squares, one even and one odd.
        square_m: side of a square as printed [m]: measure across all of them.
        square_sigma_m: 1-sigma of that measurement [m]: a caliper's 0.1 mm across five squares. One camera derives all
            distances from it, and their uncertainty in proportion.
    """

    columns: Annotated[int, Meta(le=40)]
    rows: Annotated[int, Meta(le=40)]
    square_m: Annotated[float, Meta(ge=0.001, le=1)]
    square_sigma_m: Annotated[float, Meta(ge=0)] = 0.00002

    def __post_init__(self) -> None:
        name = f"a chessboard of {self.columns}x{self.rows} squares"
        if min(self.columns, self.rows) < 4:
            raise ValueError(f"{name} is too small. Take 4 and more each way")  # any texture contains patterns like it
        if (self.columns + self.rows) % 2 == 0:
            raise ValueError(
                f"{name} looks the same turned by half a turn. Take an even and an odd number, as in 8x5 or 7x6"
            )
