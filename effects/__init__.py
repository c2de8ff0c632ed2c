"""The simulation as a pipeline of stages, and the ways in which reality differs from it.

What `diagnosis` fits is what `sim_backend` applies.
"""

from .effect import Effect
from .gravity import GravityLoad
from .kinds import KINDS, Kind
from .motion import Motion
from .parameter import Parameter
from .simulation import Simulated, Simulation

__all__ = ["KINDS", "Effect", "GravityLoad", "Kind", "Motion", "Parameter", "Simulated", "Simulation"]
