"""Find the presenter of each effect."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from bodyschema.diagnosis.report import presenters
from bodyschema.diagnosis.report.result import Indistinguishable
from bodyschema.effects import EFFECT_TYPES

from .presenter import PlainPresenter, Presenter


def presenter_of(effect: str) -> Presenter:
    """Return the presenter of an effect, or a plain one if it has none."""
    return PRESENTERS.get(effect) or PlainPresenter(EFFECT_TYPES[effect])


def named(effect: str, where: str | None, source: str | None, seen_by: str = "camera") -> str:
    """Return a cause in a few words without figures.

    Args:
        seen_by: the kind of measuring device, as in `DiagnosisFile`.
    """
    noun = presenter_of(effect).noun or PlainPresenter(EFFECT_TYPES[effect]).noun
    return noun.format(joint=where, source=source, seen_by=seen_by)


def rival_named(rival: Indistinguishable, seen_by: str = "camera") -> str:
    return rival.what or named(rival.effect, rival.where, rival.source, seen_by)


def built_in() -> dict[str, Presenter]:
    """Return one of each class of this folder, by the name of its effect."""
    modules = [import_module(f"{presenters.__name__}.{found.name}") for found in iter_modules(presenters.__path__)]
    members = [member for module in modules for member in vars(module).values()]
    classes = [m for m in members if isinstance(m, type) and issubclass(m, Presenter) and hasattr(m, "effect")]
    return {member.effect: member() for member in classes}


PRESENTERS: dict[str, Presenter] = built_in()
