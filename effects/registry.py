"""Find all effects: those of `catalogue`, and those of other packages by their entry points."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from bodyschema.robot.plugins import installed

from . import catalogue
from .effect_type import EFFECT_TYPES, STAGES, EffectType


def built_in() -> list[EffectType]:
    modules = [import_module(f"{catalogue.__name__}.{found.name}") for found in iter_modules(catalogue.__path__)]
    members = [(module.__name__, member) for module in modules for member in vars(module).values()]
    classes = [m for place, m in members if isinstance(m, type) and issubclass(m, EffectType) and m.__module__ == place]
    return [one() for one in classes if hasattr(one, "name")]


def _of_plugins() -> Iterator[EffectType]:
    for entry in installed("bodyschema.effects"):
        try:
            effect = entry.load()()
            if not isinstance(effect, EffectType):
                raise TypeError("it is not an EffectType")
        except Exception as error:
            warnings.warn(f"the effect {entry.value} of another package is left out: {error}", stacklevel=2)
            continue
        yield effect


def _all() -> dict[str, EffectType]:
    """Return all effects by stage, rank and name; of two with one name, the first."""
    found: dict[str, EffectType] = {}
    for effect in (*built_in(), *_of_plugins()):
        found.setdefault(effect.name, effect)
    return {e.name: e for e in sorted(found.values(), key=lambda e: (STAGES.index(e.stage), e.rank, e.name))}


EFFECT_TYPES.update(_all())
