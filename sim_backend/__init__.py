"""A hand-guided robot in pybullet with encoders and rendered stereo images, behind the Protocols of hardware."""

from __future__ import annotations

from .config import CameraConfig, EncoderConfig, ErrorConfig, GuideConfig, SimConfig, ToolChange
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
