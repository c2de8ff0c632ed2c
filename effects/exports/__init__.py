"""Export the simulation to formats of other programs, with a list of the effects that each cannot hold."""

from .correction import write_correction
from .mjcf import write_mjcf
from .replay import corrected, replayed
from .urdf import write_urdf

__all__ = ["corrected", "replayed", "write_correction", "write_mjcf", "write_urdf"]
