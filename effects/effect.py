"""Define one effect with its place and numbers, as in `extended.toml`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from bodyschema.interfaces.errors import RobotError
from bodyschema.interfaces.records import FloatArray, frozen_array
from bodyschema.robot.description import RobotDescription
from bodyschema.robot.suggest import did_you_mean

from .effect_type import CameraEffect, EffectType, StructureEffect
from .parameter import Parameter
from .registry import EFFECT_TYPES

# Name, where, source, and ordinal among effects of one kind at one place.
Identity = tuple[str, str | None, str | None, int]


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect of a robot."""

    kind: EffectType  # what it is
    # where, source: the joint it acts on, and the joint that causes it; None where there is none
    where: str | None
    source: str | None
    values: FloatArray  # its numbers (p,), in the order of `parameters`
    prismatic: bool = False  # True for a prismatic joint
    ordinal: int = 0  # number among several of one kind at one place, counted from 0
    free: tuple[int, ...] | None = None  # indices of the amounts that may differ from nominal; None for all

    @classmethod
    def at(
        cls,
        robot: RobotDescription,
        name: str,
        where: str | None = None,
        source: str | None = None,
        values: Mapping[str, float] | Sequence[float] | FloatArray | None = None,
    ) -> Self:
        """Create the effect called `name`; without `values` it has no influence yet.

        Raises:
            RobotError: the effect, joint or number does not exist, or the effect cannot act there.
        """
        if name not in EFFECT_TYPES:
            raise RobotError(f"there is no effect {name!r}", remedy=did_you_mean(name, EFFECT_TYPES))
        kind = EFFECT_TYPES[name]
        for joint, wanted, what in ((where, kind.at_joint, "where"), (source, kind.takes_source, "source")):
            if wanted and joint is None:
                raise RobotError(f"{name} needs a joint: {what} is missing", remedy=f"Name one of {_list(robot)}")
            if not wanted and joint is not None:
                raise RobotError(f"{name} has no {what}", remedy=f"Take {what} = {joint!r} out")
            if joint is not None and joint not in robot.joints:
                raise RobotError(
                    f"{what} = {joint!r}: no joint of this robot", remedy=did_you_mean(joint, robot.joints)
                )
        if source is not None and source == where:
            raise RobotError(f"{name}: where and source are the same joint", remedy="Name another joint as source")
        prismatic = where is not None and bool(robot.chain.prismatic[robot.joints.index(where)])
        if prismatic and kind.turns_only:
            remedy = "An eccentric pinion of a slide is a joint_ripple of its turns a metre (cycles_per_m)"
            raise RobotError(f"{name} cannot sit at {where!r}, which slides", remedy=remedy)
        if kind.needs_stereo and robot.calibration is None:
            raise RobotError(f"{name} needs a stereo camera", remedy="Add focal_px and its fellows to [camera]")
        parameters = kind.sliding if prismatic else kind.turning
        return cls(kind, where, source, _values(parameters, values, name), prismatic)

    @property
    def name(self) -> str:
        """Name of its type."""
        return self.kind.name

    @property
    def key(self) -> tuple[str, str | None, str | None]:
        """Identity without numbers: name, where, source."""
        return self.kind.name, self.where, self.source

    @property
    def identity(self) -> Identity:
        """Identity among the effects of one simulation: `key` and `ordinal`."""
        return *self.key, self.ordinal

    @cached_property
    def frame(self) -> FloatArray | None:
        """Pose (4, 4) of its joint's frame in the nominal frame; None if it does not move it."""
        return self.kind.frame(self.values) if isinstance(self.kind, StructureEffect) else None

    @cached_property
    def pose(self) -> FloatArray | None:
        """Pose (4, 4) of the camera in its frame before; None if it does not move it."""
        return self.kind.pose(self.values) if isinstance(self.kind, CameraEffect) else None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of its values."""
        return self.kind.sliding if self.prismatic else self.kind.turning

    @cached_property
    def all_amounts(self) -> list[int]:
        """Indices of the values that are amounts."""
        return [k for k, parameter in enumerate(self.parameters) if parameter.is_amount]

    @cached_property
    def amounts(self) -> list[int]:
        """Indices of the values that are amounts, and free."""
        own = self.all_amounts
        return own if self.free is None else [k for k in own if k in self.free]

    @property
    def told(self) -> list[int]:
        """Indices of the values that describe it: all but amounts that are not free."""
        amounts = self.amounts
        return [k for k, parameter in enumerate(self.parameters) if k in amounts or not parameter.is_amount]

    @cached_property
    def shapes(self) -> list[int]:
        """Indices of the smooth shape values: periods and time constants."""
        return [k for k, parameter in enumerate(self.parameters) if parameter.smooth]

    @property
    def is_possible(self) -> bool:
        """True if no value is negative that must not be."""
        return not any(p.never_negative and value < 0.0 for p, value in zip(self.parameters, self.values, strict=True))

    def with_values(self, values: FloatArray) -> Effect:
        """Return the same effect with other values (p,)."""
        # Several times as fast as `replace`.
        frozen = frozen_array(values)
        return Effect(self.kind, self.where, self.source, frozen, self.prismatic, self.ordinal, self.free)

    def freeing(self, free: tuple[int, ...] | None) -> Effect:
        """Return the same effect with these amounts free, all for None, and the others nominal."""
        freed = replace(self, free=free)
        fixed = [k for k in range(len(self.values)) if k not in freed.told]
        values = self.values.copy()
        values[fixed] = [self.parameters[k].nominal for k in fixed]
        return freed.with_values(values)

    def one_more(self, ordinal: int) -> Effect:
        """Return another effect of the same kind and place, with the same numbers."""
        return replace(self, ordinal=ordinal)

    def value(self, name: str) -> float:
        """Return the value called `name`; raise KeyError if there is none."""
        named = dict(zip([parameter.name for parameter in self.parameters], self.values.tolist(), strict=True))
        return named[name]

    def table(self) -> dict[str, Any]:
        """Return the effect as a table of `extended.toml`."""
        head = {"effect": self.name, "where": self.where, "source": self.source}
        numbers = {self.parameters[k].name: float(self.values[k]) for k in self.told}
        return {key: value for key, value in head.items() if value is not None} | numbers


def _values(
    parameters: tuple[Parameter, ...], given: Mapping[str, float] | Sequence[float] | FloatArray | None, name: str
) -> FloatArray:
    start = [p.usual if p.nominal is None else p.nominal for p in parameters]
    if given is None:
        return frozen_array(start)
    if isinstance(given, Mapping):
        names = [p.name for p in parameters]
        for key in given:
            if key not in names:
                raise RobotError(f"{name} has no number {key!r}", remedy=did_you_mean(key, names))
        given = [given.get(p.name, at_rest) for p, at_rest in zip(parameters, start, strict=True)]
    values = np.asarray(given, dtype=np.float64)
    if values.shape != (len(parameters),):
        raise RobotError(f"{name} has {len(parameters)} numbers, not {values.size}")
    for parameter, value in zip(parameters, values, strict=True):
        if not np.isfinite(value) or (parameter.positive and value <= 0.0):
            raise RobotError(f"{name}: {parameter.name} = {value:g} cannot be")
    return frozen_array(values)


def _list(robot: RobotDescription) -> str:
    return ", ".join(robot.joints)
