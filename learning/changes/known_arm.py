"""Posterior of the arm itself, independent of its tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bodyschema.interfaces.records import FloatArray
from kbmaps import ChainBelief, ChainTolerances, ResidualModel

# 1-sigma of each coordinate [m] of the marker's displacement by another tool, and of an unknown marker position about
# the nominal one.
OTHER_TOOL_M = 0.25


@dataclass(frozen=True, eq=False)
class KnownArm:
    """Current knowledge of the arm.

    Attributes:
        chain: posterior as a rigid chain.
        tolerances: those of its prior.
        residual: posterior as a chain with deviations; None if there is none.
    """

    chain: ChainBelief
    tolerances: ChainTolerances
    residual: ResidualModel | None = None

    @classmethod
    def from_bytes(cls, chain: bytes, tolerances: ChainTolerances, residual: bytes | None) -> KnownArm:
        """Return the arm from the bytes of its parts' `to_bytes`."""
        known = None if residual is None else ResidualModel.from_bytes(residual)
        return cls(ChainBelief.from_bytes(chain), tolerances, known)

    def updated(self, chain: ChainBelief | None, residual: ResidualModel | None) -> KnownArm:
        """Return the arm with newer posteriors; None keeps the current one."""
        return KnownArm(chain or self.chain, self.tolerances, residual or self.residual)

    def with_other_tool(self) -> KnownArm:
        """Return the same arm with a marker elsewhere on the hand."""
        residual = None if self.residual is None else self.residual.with_other_tool(OTHER_TOOL_M)
        return KnownArm(self.chain.with_other_tool(OTHER_TOOL_M), self.tolerances, residual)

    def widened(self, columns: NDArray[np.intp], std: FloatArray) -> KnownArm:
        """Return the same arm with the uncertainty of some chain parameters increased.

        Args:
            columns: indices (k,) of these parameters.
            std: 1-sigma of each change (k,) [rad, m].
        """
        residual = None if self.residual is None else self.residual.widened(columns, std)
        return KnownArm(self.chain.widened(columns, std), self.tolerances, residual)
