"""Choice of the hidden effects, of their joints and of the kind of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .arms import ARMS, FLOOR, Arm
from .hidden import Kind
from .kinds import KINDS
from .motion import Style
from .outside import OUTSIDE
from .structure import bending_joints

HOLDS = ("torque_free", "zero_force", "held")
EVERY = {**KINDS, **OUTSIDE}


@dataclass(frozen=True)
class Wish:
    """An effect to hide; a joint that is None is chosen at random."""

    effect: str
    where: str | None = None
    source: str | None = None

    @property
    def kind(self) -> Kind:
        """Description of the effect."""
        return EVERY[self.effect]

    @classmethod
    def parsed(cls, text: str) -> Wish:
        """Parse `effect`, `effect@joint` or `effect@joint:source`.

        Raises:
            ValueError: there is no such effect.
        """
        effect, _, at = text.partition("@")
        if effect not in EVERY:
            raise ValueError(f"there is no effect {effect!r}; there are {', '.join(EVERY)}")
        where, _, source = at.partition(":")
        return cls(effect, where or None, source or None)


def wishes(
    effects: int | str | Sequence[str], hold: str | None, rough: Sequence[str], rng: np.random.Generator
) -> list[Wish]:
    """Return the effects to hide: those named, "outside" for one outside the table, or a number of random ones.

    Effects in `rough` are not findings in this case and are not chosen.
    """
    if isinstance(effects, str):
        effects = [effects]
    if not isinstance(effects, int):
        return [
            Wish(str(rng.choice(_shown(OUTSIDE, hold)))) if name == "outside" else Wish.parsed(name) for name in effects
        ]
    names = [name for name in _shown(KINDS, hold) if name not in rough]
    return [Wish(str(name)) for name in rng.choice(names, effects, replace=False)]


def _shown(kinds: dict[str, Kind], hold: str | None) -> list[str]:
    """Return the effects that show while the arm's weight is supported as `hold` says."""
    return [
        name
        for name, kind in kinds.items()
        if not (kind.bears and hold == "torque_free") and not (hold == "held" and "held" not in kind.styles)
    ]


def chosen_arm(arm: str | None, wished: Sequence[Wish], rng: np.random.Generator) -> Arm:
    """Return the arm of that name, or a random one that the effects can act on."""
    beside = any(wish.kind.beside_only for wish in wished)
    if arm == "head" and beside:
        raise ValueError("with the cameras on the robot nobody sees its mount give way")
    if arm is None:
        arm = str(rng.choice([name for name in ARMS if not (beside and name == "head")]))
    if arm not in ARMS:
        raise ValueError(f"there is no arm {arm!r}; there are {', '.join(ARMS)}")
    return ARMS[arm](rng)


def chosen_motion(hold: str | None, wished: Sequence[Wish], rng: np.random.Generator) -> tuple[str, Style]:
    """Return who supports the arm's weight and the kind of motion, chosen so that every effect shows.

    Raises:
        ValueError: no motion shows them all while the weight is borne as `hold` says.
    """
    shown = [
        name for name in HOLDS if all(wish.effect in _shown(EVERY, name) for wish in wished) and hold in (None, name)
    ]
    if not shown:
        raise ValueError(f"with hold = {hold} not all of these show: {', '.join(wish.effect for wish in wished)}")
    hold = str(rng.choice(shown))
    if hold == "held":
        return hold, "held"
    effects = {wish.effect for wish in wished}
    return hold, "stepped" if "settling" in effects and "camera_latency" not in effects else "walk"


def placed(wish: Wish, arm: Arm, taken: Sequence[tuple[str, str | None]], rng: np.random.Generator) -> Wish:
    """Return the wish with random joints, none of which already has the same effect."""
    kind = wish.kind
    if kind.at == "robot":
        return wish
    for name in (wish.where, wish.source):
        if name is not None and name not in arm.read:
            raise ValueError(f"{arm.name} reads no joint {name!r}; it reads {', '.join(arm.read)}")
    free = [name for name in _possible(wish.effect, arm) if (wish.effect, name) not in taken]
    where = wish.where or str(rng.choice(free))
    if kind.at == "joint":
        return Wish(wish.effect, where)
    return Wish(wish.effect, where, wish.source or str(rng.choice([name for name in arm.read if name != where])))


def _possible(effect: str, arm: Arm) -> tuple[str, ...]:
    """Return the joints at which the effect is possible."""
    if effect == "link_bend":
        return bending_joints(arm)
    if effect == "growing_link" and arm.camera_link == FLOOR:
        return arm.read[1:]  # before the first joint growth is a drift of the whole frame
    return arm.read
