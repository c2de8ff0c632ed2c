"""Structure that no effect fits: which joints it depends on, and a smooth model of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from interfaces.records import FloatArray

from .explanation import Explanation
from .held_out import Blocks
from .sensitivity import joints_of
from .unknown import Unknowns


@dataclass(frozen=True, eq=False)
class Leftover:
    """What is left when all causes have been named.

    Attributes:
        what: what moves, and on what it depends, in words.
        joints: at which joints it acts or on which it depends, by their places in q.
        with_time: whether it depends on time.
        p_value: of so much structure by chance.
        explained: what smooth functions predict of it (n, 3) [m].
        held_out: the same (n, 3) [m], of rows that they were not fitted to.
    """

    what: tuple[str, ...]
    joints: tuple[int, ...]
    with_time: bool
    p_value: float
    explained: FloatArray
    held_out: FloatArray

    @property
    def is_there(self) -> bool:
        """Whether there is any structure."""
        return bool(self.what)


def leftover(explanation: Explanation, unknowns: Unknowns, blocks: Blocks) -> Leftover:
    """What the families of an explanation say of what its causes leave."""
    fit = explanation.fit
    if not explanation.unknown:
        index, _ = unknowns.best(fit)
        gain, dof = unknowns.gain(fit, (index,))
        p_value = float(min(1.0, stats.chi2.sf(gain, dof) * len(unknowns.families)))
        nothing = np.zeros_like(fit.residuals)
        return Leftover((), (), False, p_value, nothing, nothing)
    families = [unknowns.families[index] for index in explanation.unknown]
    gain, dof = unknowns.gain(fit, explanation.unknown)
    explained, held_out = unknowns.predicted(fit, explanation.unknown, blocks)
    numbers = unknowns.numbers(fit, explanation.unknown)
    joints = [joints_of(family, own, fit.run) for family, own in zip(families, numbers, strict=True)]
    return Leftover(
        what=tuple(family.what for family in families),
        joints=tuple(sorted(frozenset[int]().union(*joints))),
        with_time=any(family.over_time for family in families),
        p_value=float(stats.chi2.sf(gain, dof)),
        explained=explained,
        held_out=held_out,
    )
