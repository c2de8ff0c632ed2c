"""Simulate a robot as a pipeline of stages, with the effects by which reality differs from the nominal model.

`diagnosis` fits the same effects that `sim_backend` applies.
"""

from bodyschema.effects.corrected import LiveEncoders
from bodyschema.effects.simulation import PipelineRun

from .corrected import corrected_file, write_corrected
from .effect_type import Effect, EffectType, Identity
from .files import load_simulation, read_effects, read_unexplained, simulation_of, write_extended
from .gravity import GravityLoad
from .motion import Motion
from .parameter import Parameter
from .registry import EFFECT_TYPES
from .simulation import Residual, Simulation
from .smooth_map import place_map, smooth_map
from .unexplained import StoredModel, Unexplained

__all__ = [
    "EFFECT_TYPES",
    "Effect",
    "EffectType",
    "GravityLoad",
    "Identity",
    "LiveEncoders",
    "Motion",
    "Parameter",
    "PipelineRun",
    "Residual",
    "Simulation",
    "StoredModel",
    "Unexplained",
    "corrected_file",
    "load_simulation",
    "place_map",
    "read_effects",
    "read_unexplained",
    "simulation_of",
    "smooth_map",
    "write_corrected",
    "write_extended",
]
