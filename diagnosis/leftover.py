"""Structure that no effect fits: which joints it depends on, and a smooth model of it."""

from __future__ import annotations

from dataclasses import dataclass

from scipy import stats

from .explanation import Explanation
from .fit import Fit
from .held_out import Blocks
from .sensitivity import joints_of
from .smooth import SmoothModel, smooth_model
from .unknown import Apart, Unknowns


@dataclass(frozen=True, eq=False)
class Leftover:
    """What is left when all causes have been named.

    Attributes:
        what: what moves, and on what it depends, in words.
        joints: at which joints it acts or on which it depends, by their places in q.
        with_time: whether it depends on time.
        p_value: of so much structure by chance.
        model: the causes beside a smooth model of it; None where nothing is left.
        untold: what it depends on time, in words, so that it is in no model that can be stored.
    """

    what: tuple[str, ...]
    joints: tuple[int, ...]
    with_time: bool
    p_value: float
    model: SmoothModel | None = None
    untold: tuple[str, ...] = ()

    @property
    def is_there(self) -> bool:
        """Whether there is any structure."""
        return bool(self.what)


def leftover(explanation: Explanation, unknowns: Unknowns, blocks: Blocks) -> Leftover:
    """What the families of an explanation say of what its causes leave."""
    fit, apart = explanation.fit, explanation.apart
    if fit.is_exact:
        return Leftover((), (), False, 1.0)
    if apart is None:
        beside = unknowns.apart(fit, (unknowns.nearest(fit)[0][0],))
        return Leftover((), (), False, min(1.0, _chance(fit, beside, unknowns) * unknowns.count))
    families = [way.family for way in apart.chosen]
    joints = [joints_of(family, own, fit.run) for family, own in zip(families, apart.numbers, strict=True)]
    return Leftover(
        what=tuple(family.what for family in families),
        joints=tuple(sorted(frozenset[int]().union(*joints))),
        with_time=any(family.over_time for family in families),
        p_value=_chance(fit, apart, unknowns),
        model=smooth_model(fit, apart, families, blocks),
        untold=tuple(family.what for family in families if family.over_time),
    )


def _chance(fit: Fit, apart: Apart, unknowns: Unknowns) -> float:
    """Of so much structure where there is none."""
    gain = 2.0 * (apart.fit.log_likelihood - fit.log_likelihood)
    return float(stats.chi2.sf(max(gain, 0.0), max(unknowns.told(apart).shape[2] + apart.choice, 1)))
