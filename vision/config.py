"""The table [vision] of robot.toml."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from bodyschema.interfaces.errors import ConfigError
from bodyschema.robot.plugins import PluginConfig
from bodyschema.robot.toml_file import Fraction, Positive
from bodyschema.vision.cameras.config import CamerasConfig, FurtherCameras
from bodyschema.vision.tags.config import ChessboardConfig, ClusterConfig, TagConfig

# After a longer pause the last fixes of a marker predict nothing [s].
LONGEST_PAUSE_S = 0.5

MarkerKind = Literal["ball", "bright_ball", "tag", "cluster", "chessboard", "plugin"]
ColourName = Literal["red", "orange", "yellow", "green", "cyan", "blue", "magenta"]


class HueBand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A band of hues with the least saturation and brightness of a pixel."""

    # centre of the band on the colour circle [deg]; red 0, green 120, blue 240
    hue_deg: Annotated[float, Meta(ge=0, lt=360)]
    half_width_deg: Annotated[float, Meta(gt=0, le=90)] = 16.0  # largest distance from the centre [deg]
    min_saturation: Fraction = 0.5  # 0 is grey, 1 a pure colour
    min_value: Fraction = 0.15  # 0 is black, 1 the brightest the camera can tell


NAMED_COLOURS: dict[str, HueBand] = {
    "red": HueBand(0.0),
    "orange": HueBand(28.0, half_width_deg=12.0),
    "yellow": HueBand(56.0, half_width_deg=14.0),
    "green": HueBand(120.0, half_width_deg=30.0),
    "cyan": HueBand(180.0, half_width_deg=20.0),
    "blue": HueBand(230.0, half_width_deg=24.0),
    "magenta": HueBand(310.0, half_width_deg=24.0),
}


class VisionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table [vision]: appearance of the marker, and the cameras that see it."""

    # what is looked for: a coloured ball, a ball that is brighter than all around it, one tag ([vision.tag]), a rigid
    # cluster of tags ([vision.cluster]), a plain chessboard ([vision.chessboard]), or what a tracker of another package
    # finds ([vision.plugin]). The other keys of this table are a ball's.
    marker: MarkerKind = "ball"
    colour: ColourName | HueBand = "red"  # a name, or a band of hues as the table [vision.colour]
    radius_m: Positive = 0.020  # radius of the marker ball [m]
    # of a bright ball, where 1 is the brightest that the camera can tell
    min_brightness: Annotated[float, Meta(gt=0, le=1)] = 0.6
    cameras: CamerasConfig | None = None  # where images come from; without it there are none
    further_cameras: tuple[FurtherCameras, ...] = ()  # others that see the same marker; their positions are fused
    tag: TagConfig = TagConfig()  # the tag, or the properties common to the tags of a cluster
    cluster: ClusterConfig = ClusterConfig()  # where on the marker which tag is
    chessboard: ChessboardConfig | None = None  # the squares of a chessboard
    plugin: PluginConfig | None = None  # the tracker of another package

    @property
    def band(self) -> HueBand:
        """The colour as a band of hues."""
        return NAMED_COLOURS[self.colour] if isinstance(self.colour, str) else self.colour

    @property
    def board(self) -> ChessboardConfig:
        """The chessboard; raises ConfigError if there is none."""
        if self.chessboard is None:
            raise ConfigError(
                '[vision] marker = "chessboard" names none',
                remedy="Add [vision.chessboard] with its columns, rows and square_m",
            )
        return self.chessboard

    @property
    def readout(self) -> tuple[float, float]:
        """Readout time of the cameras' rows and its 1-sigma [s]; 0 without [vision.cameras], for a global shutter."""
        return (0.0, 0.0) if self.cameras is None else self.cameras.readout

    @property
    def size_sigma(self) -> float:
        """Relative 1-sigma of the size of tags or a chessboard."""
        if self.marker == "chessboard":
            return self.board.square_sigma_m / self.board.square_m
        return self.tag.side_sigma_m / self.tag.side_m
