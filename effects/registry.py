"""Find all effects: those of `catalogue`, and those of other packages by their entry points."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules

from bodyschema.robot.plugins import installed

from . import catalogue
from .effect_type import STAGES, EffectType


def built_in() -> list[EffectType]:
    """Return one of each class with a name in `catalogue`, by stage, rank and name."""
    modules = [import_module(f"{catalogue.__name__}.{found.name}") for found in iter_modules(catalogue.__path__)]
    effects = [member() for module in modules for member in vars(module).values() if _is_defined_in(module, member)]
    return sorted(effects, key=lambda effect: (STAGES.index(effect.stage), effect.rank, effect.name))


def _is_defined_in(module: object, member: object) -> bool:
    own = isinstance(member, type) and issubclass(member, EffectType) and hasattr(member, "name")
    return own and getattr(member, "__module__", None) == getattr(module, "__name__", "")


def _of_plugins(names: set[str]) -> Iterator[EffectType]:
    """Yield the effects of other packages that load; built-in names take precedence."""
    for entry in installed("bodyschema.effects"):
        try:
            effect = entry.load()()
        except Exception as error:
            warnings.warn(f"the effect {entry.value} of another package is left out: {error}", stacklevel=2)
            continue
        if effect.name not in names:
            names.add(effect.name)
            yield effect


def _all() -> dict[str, EffectType]:
    own = built_in()
    encoder = [effect for effect in own if effect.encoder is not None]
    others = [effect for effect in own if effect.encoder is None]
    return {e.name: e for e in (*encoder, *_of_plugins({effect.name for effect in own}), *others)}


EFFECT_TYPES: dict[str, EffectType] = _all()
