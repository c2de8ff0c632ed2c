"""Fits of an unknown frame or a changed tool as a whole, before anything is learnt on top."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bodyschema.interfaces.records import FloatArray
from bodyschema.learning.nominal import PAIRS_TO_REFIT, NominalModel
from bodyschema.learning.solvers.solver import fitted_belief
from kbmaps import ChainBelief, ChainTolerances, DegenerateDataError, KBMap, RigidChain


@dataclass(frozen=True)
class Fit:
    """Prior that was fitted to pairs.

    Attributes:
        prior: the map to learn on top of.
        chain: the nominal chain, placed; after a tool change, the chain that gives the orientation of the hand.
        belief: posterior of the chain; None after a tool change, where only the tool is fitted.
    """

    prior: KBMap
    chain: RigidChain
    belief: ChainBelief | None = None


class Fitting:
    """Schedules and makes the fits: at first after few pairs, then whenever they have doubled."""

    def __init__(self, nominal: NominalModel, tolerances: ChainTolerances) -> None:
        self._nominal, self._tolerances = nominal, tolerances
        self._chain = nominal.chain
        self._before: KBMap | None = None
        self._due_at = None if nominal.frame_known else nominal.pairs_to_align
        self._is_first = True

    @property
    def due_at(self) -> int | None:
        """Number of pairs at the next fit; None if nothing is to be fitted."""
        return self._due_at

    @property
    def is_first(self) -> bool:
        """True if nothing has been fitted yet."""
        return self._is_first

    @property
    def chain(self) -> RigidChain:
        """Nominal chain, placed; after a tool change, the chain that gives the orientation of the hand."""
        return self._chain

    def due(self, pairs: int) -> bool:
        """Return True if it is time to fit."""
        return self._due_at is not None and pairs >= self._due_at

    def change_tool(self, before: KBMap, hand: RigidChain, first_at: int = PAIRS_TO_REFIT) -> None:
        """Fit another tool on top of the map `before` from now on, at first to `first_at` pairs.

        Args:
            before: the map to fit on top of.
            hand: a chain that gives the orientation of the hand.
            first_at: number of pairs at the first fit.
        """
        self._before, self._chain, self._due_at, self._is_first = before, hand, first_at, True

    def rest(self, hand: RigidChain) -> None:
        """Stop fitting.

        Args:
            hand: a chain that gives the orientation of the hand.
        """
        self._before, self._chain, self._due_at, self._is_first = None, hand, None, False

    def fit(self, q: FloatArray, x: FloatArray) -> Fit | None:
        """Return the prior that fits pairs q (n, d) [rad] and x (n, 3) [m] best; None if they do not determine it.

        With an unknown frame, that is the most probable chain. A frame alone, fitted to an inaccurate nominal chain,
        would absorb the arm's errors near the first pairs, and be far off everywhere else.
        """
        try:
            if self._before is not None:
                return Fit(self._nominal.with_other_tool(self._before, self._chain, q, x), self._chain)
            placed = self._nominal.placed(q, x)
        except DegenerateDataError:
            return None
        belief = fitted_belief(self._nominal.belief(placed, self._tolerances), q, x)
        return Fit(belief.chain.to_kbmap(self._nominal.bases), placed, belief)

    def done(self, pairs: int, fit: Fit | None) -> None:
        """Record a fit to this many pairs."""
        if fit is None:
            self._due_at = pairs + max(self._nominal.pairs_to_align, PAIRS_TO_REFIT)
        else:
            self._due_at, self._chain, self._is_first = 2 * pairs, fit.chain, False

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a checkpoint, in addition to `due_at` and `is_first`."""
        kept = {"chain_fixed": self._chain.fixed}
        return kept if self._before is None else kept | {"before_change": self._before.net}

    def restore(self, due_at: int | None, is_first: bool, arrays: Mapping[str, FloatArray]) -> None:
        """Resume from these and from `arrays`."""
        nominal = self._nominal.chain
        self._due_at, self._is_first = due_at, is_first
        self._chain = RigidChain(arrays["chain_fixed"], nominal.axes, nominal.prismatic)
        if "before_change" in arrays:
            self._before = KBMap(self._nominal.bases, arrays["before_change"])
