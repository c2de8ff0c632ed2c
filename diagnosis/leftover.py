"""Structure that no effect fits: which joints it depends on, and a smooth model of it."""

from __future__ import annotations

from dataclasses import dataclass

from scipy import stats

from .explanation import Explanation
from .held_out import Blocks
from .smooth import SmoothModel, smooth_model
from .unknown import TIME, Unknowns


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
    fit = explanation.fit
    if not explanation.unknown:
        index, _ = unknowns.best(fit)
        gain, dof = unknowns.gain(fit, (index,))
        p_value = float(min(1.0, stats.chi2.sf(gain, dof) * len(unknowns.families)))
        return Leftover((), (), False, p_value)
    families = [unknowns.families[index] for index in explanation.unknown]
    gain, dof = unknowns.gain(fit, explanation.unknown)
    involved = {joint for family in families for joint in (*family.at, *family.drivers)}
    return Leftover(
        what=tuple(family.what for family in families),
        joints=tuple(sorted(involved - {TIME})),
        with_time=TIME in involved,
        p_value=float(stats.chi2.sf(gain, dof)),
        model=smooth_model(fit, families, blocks),
        untold=tuple(family.what for family in families if TIME in family.drivers),
    )
