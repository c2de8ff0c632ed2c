"""A hand-guided robot in pybullet with encoders and rendered stereo images, behind the Protocols of hardware."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from .config import CameraConfig, EncoderConfig, ErrorConfig, GuideConfig, SimConfig, ToolChange

if TYPE_CHECKING:
    from .models import model_file
    from .world import SimWorld, true_chain

__all__ = [
    "CameraConfig",
    "EncoderConfig",
    "ErrorConfig",
    "GuideConfig",
    "SimConfig",
    "SimWorld",
    "ToolChange",
    "model_file",
    "true_chain",
]

# Reading robot.toml needs the table [sim] alone: the world is imported when it is first asked for.
_HOMES = {"SimWorld": ".world", "model_file": ".models", "true_chain": ".world"}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'sim_backend' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name], __name__), name)
