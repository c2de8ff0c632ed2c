"""The marker as a rigid body: positions of the tags on it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from bodyschema.interfaces.errors import ConfigError
from bodyschema.interfaces.records import FloatArray, frozen_array

from .config import ChessboardConfig, ClusterConfig, PlacedTag, TagConfig

if TYPE_CHECKING:
    from bodyschema.vision.config import VisionConfig

# Corners of a tag of side 1 in its own frame (x right, y up, z out of it): as `TagImage` has them.
TAG_CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


class TagBody:
    """Tags on a rigid body.

    Attributes:
        corners: corners in the body's frame (4, 3) [m], by tag number; a chessboard is a tag with more corners.
    """

    def __init__(self, tags: Mapping[int, FloatArray]) -> None:
        self.corners: Mapping[int, FloatArray] = MappingProxyType({i: frozen_array(c) for i, c in tags.items()})

    @classmethod
    def of(cls, config: VisionConfig) -> TagBody:
        """Create the body of [vision].

        Raises:
            ConfigError: it is not described.
        """
        match config.marker:
            case "cluster":
                return cls.cluster(config.cluster, config.tag)
            case "chessboard":
                return cls.chessboard(config.board)
            case _:
                return cls.single(config.tag)

    @classmethod
    def chessboard(cls, config: ChessboardConfig) -> TagBody:
        """Create a body from the inner corners (n, 3) of a chessboard, row by row, with its frame in its middle."""
        columns, rows = np.meshgrid(np.arange(1, config.columns), np.arange(1, config.rows))
        across, up = columns - 0.5 * config.columns, 0.5 * config.rows - rows
        places = np.stack([across.ravel(), up.ravel(), np.zeros(across.size)], axis=1)
        return cls({0: np.asarray(config.square_m * places, np.float64)})

    @classmethod
    def single(cls, config: TagConfig) -> TagBody:
        """Create a body from one tag, whose frame is the body's."""
        return cls({config.id: config.side_m * TAG_CORNERS})

    @classmethod
    def cluster(cls, config: ClusterConfig, tag: TagConfig) -> TagBody:
        """Create a body from the tags of a cluster.

        Raises:
            ConfigError: there are no tags, or one is listed twice.
        """
        if not config.tags:
            raise ConfigError(
                "[vision.cluster] has no tags",
                remedy="Add a table [[vision.cluster.tags]] with id, xyz and rpy for each",
            )
        ids = [placed.id for placed in config.tags]
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise ConfigError(
                f"[vision.cluster] has the tag {twice[0]} twice", remedy="Print another number on one of them"
            )
        return cls({placed.id: _placed(placed, tag.side_m) for placed in config.tags})


def bends(corners: FloatArray) -> FloatArray:
    """Return the heights (k, 3) of a plate's corners (k, 3) if it is bent along x, twisted, or bent along y.

    Each is relative to the plane nearest to the corners, and of RMS 1.
    """
    x, y, _ = corners.T
    flat, curved = np.stack([np.ones_like(x), x, y], axis=1), np.stack([x * x, x * y, y * y], axis=1)
    heights = curved - flat @ np.linalg.lstsq(flat, curved, rcond=None)[0]
    return heights / np.sqrt(np.square(heights).mean(axis=0))


def _placed(placed: PlacedTag, side_m: float) -> FloatArray:
    turn = Rotation.from_euler("xyz", placed.rpy).as_matrix()
    return (placed.side_m or side_m) * TAG_CORNERS @ turn.T + np.array(placed.xyz)
