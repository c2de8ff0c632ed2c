"""What [vision] looks for, put into the simulated hand."""

from __future__ import annotations

import msgspec

from sim_backend.config import SimConfig, SimTag
from vision.config import VisionConfig
from vision.tag_config import PlacedTag

from .config import Config


def simulation_settings(config: Config) -> SimConfig:
    """The table [sim], with the tags that [vision] looks for in the hand unless [sim.camera] names others."""
    sim, vision = config.tables.sim, config.tables.vision
    if vision.marker == "ball" or sim.camera.tags:
        return sim
    from vision.tag_tracker import DICTIONARIES

    number = DICTIONARIES[vision.tag.dictionary]
    camera = msgspec.structs.replace(sim.camera, tags=_tags(vision), tag_dictionary=number)
    return msgspec.structs.replace(sim, camera=camera)


def _tags(vision: VisionConfig) -> tuple[SimTag, ...]:
    placed = (PlacedTag(id=vision.tag.id),) if vision.marker == "tag" else vision.cluster.tags
    return tuple(SimTag(id=tag.id, xyz=tag.xyz, rpy=tag.rpy, side_m=tag.side_m or vision.tag.side_m) for tag in placed)
