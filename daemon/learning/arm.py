"""What is believed of the arm itself, whatever its tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances, ResidualModel

# How far another tool may hold the marker from where the last one did, and a marker whose place is not known from where
# it is drawn, 1-sigma of each coordinate [m].
OTHER_TOOL_M = 0.25


@dataclass(frozen=True, eq=False)
class KnownArm:
    """The arm as far as it is known.

    Attributes:
        chain: as a rigid chain.
        tolerances: those that this began with.
        residual: as a chain and what it errs by; None: nothing is known of that.
    """

    chain: ChainBelief
    tolerances: ChainTolerances
    residual: ResidualModel | None = None

    @classmethod
    def from_bytes(cls, chain: bytes, tolerances: ChainTolerances, residual: bytes | None) -> KnownArm:
        """Read what `to_bytes` of its parts wrote."""
        known = None if residual is None else ResidualModel.from_bytes(residual)
        return cls(ChainBelief.from_bytes(chain), tolerances, known)

    def updated(self, chain: ChainBelief | None, residual: ResidualModel | None) -> KnownArm:
        """With what was found since; None: as before."""
        return KnownArm(chain or self.chain, self.tolerances, residual or self.residual)

    def with_other_tool(self) -> KnownArm:
        """The same arm with a marker that is elsewhere on the hand."""
        residual = None if self.residual is None else self.residual.with_other_tool(OTHER_TOOL_M)
        return KnownArm(self.chain.with_other_tool(OTHER_TOOL_M), self.tolerances, residual)

    def widened(self, columns: NDArray[np.intp], std: FloatArray) -> KnownArm:
        """The same arm where some of the chain's parameters (k,) were changed, by `std` (k,) [rad, m] (1-sigma)."""
        residual = None if self.residual is None else self.residual.widened(columns, std)
        return KnownArm(self.chain.widened(columns, std), self.tolerances, residual)
