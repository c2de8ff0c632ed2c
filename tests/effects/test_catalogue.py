"""Each effect is one class in one file, and nothing else compares its name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bodyschema.diagnosis.presenters.registry import PRESENTERS
from bodyschema.effects import EFFECT_TYPES
from bodyschema.effects.effect_type import STAGES

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", list(EFFECT_TYPES))
def test_an_effect_has_a_file_and_a_presenter(name: str) -> None:
    for file in (ROOT / "effects" / "catalogue" / f"{name}.py", ROOT / "diagnosis" / "presenters" / f"{name}.py"):
        assert file.exists()
    assert type(EFFECT_TYPES[name]).__module__.endswith(f"catalogue.{name}")
    assert type(PRESENTERS[name]).__module__.endswith(f"presenters.{name}")


def test_effects_are_listed_by_stage() -> None:
    stages = [STAGES.index(effect.stage) for effect in EFFECT_TYPES.values()]
    assert stages == sorted(stages)


@pytest.mark.parametrize("room", ["effects", "diagnosis"])
def test_no_module_compares_the_name_of_an_effect(room: str) -> None:
    quoted = "|".join(EFFECT_TYPES)
    asked = re.compile(rf"\.name (==|in )|(==|!=| in|case) [(\[{{]?\"({quoted})\"")
    lines = [
        f"{file.relative_to(ROOT)}: {line}"
        for file in (ROOT / room).rglob("*.py")
        for line in file.read_text(encoding="utf-8").splitlines()
        if asked.search(line)
    ]
    assert lines == []


@pytest.mark.parametrize("name", [name for name, effect in EFFECT_TYPES.items() if effect.stays_as])
def test_a_permanent_form_has_the_same_amounts(name: str) -> None:
    effect = EFFECT_TYPES[name]
    assert effect.begins
    permanent = EFFECT_TYPES[str(effect.stays_as)]
    for before, after in ((effect.turning, permanent.turning), (effect.sliding, permanent.sliding)):
        units = [[parameter.name.rpartition("_")[2] for parameter in some] for some in (before[:-1], after)]
        assert units[0] == units[1]


@pytest.mark.parametrize("name", [name for name, effect in EFFECT_TYPES.items() if effect.search != "none"])
def test_a_searched_shape_comes_last(name: str) -> None:
    *amounts, shape = EFFECT_TYPES[name].turning
    assert all(parameter.is_amount for parameter in amounts)
    assert shape.is_amount == (EFFECT_TYPES[name].search == "width")
