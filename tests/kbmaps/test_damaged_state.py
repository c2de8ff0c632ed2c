"""Stored models with a valid checksum and inconsistent parts."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for
from rough_arms import ROUGH, rough_arm

from kbmaps import (
    NLMS,
    ChainTolerances,
    KernelLearner,
    Memory,
    ModelFormatError,
    RecursiveRigidLearner,
    ResidualLearner,
    RigidLearner,
    TensorLearner,
    TensorTrain,
)
from kbmaps.packed import MAGIC, VERSION, pack

KINDS = "RPR"
BASES = bases_for(KINDS)
PREFIX = struct.Struct("<8sII")
# Replacements of a number, a text or an object: values of another type.
WRONG = ([], "1e400", "1" + "0" * 400, "-Infinity", [[1.0]])
# NaN has a meaning here: not given, not predicted.
WITH_NAN = ("sigma", "errors")


@functools.cache
def stored() -> dict[str, tuple[Any, bytes]]:
    """Return, by name, the reading class and the bytes of trained models."""
    rng = np.random.default_rng(1)
    arm = rough_arm(rng, KINDS)
    q, x = arm.pairs(rng, 40, 0.01)
    x = x + 0.05 * np.sin(2.0 * q)
    residual = ResidualLearner(arm.nominal, ROUGH)
    models: dict[str, Any] = {
        "rigid": RigidLearner(arm.nominal, ChainTolerances(axes=0.1, points=0.05, tool=math.inf)),
        "recursive": RecursiveRigidLearner(arm.nominal, ROUGH, window=16),
        "residual": residual,
        "kernel": KernelLearner(BASES, arm.nominal, memory=Memory(8, 0.95)),
        "kernel on a map": KernelLearner(BASES, arm.nominal.to_kbmap(BASES), precision=0.1),
        "kernel, from nothing": KernelLearner(BASES),
        "tensor": TensorLearner.around(arm.nominal, BASES),
        "tensor, from nothing": TensorLearner(BASES),
    }
    for model in models.values():
        model.learn(q, x)
    models["residual model"] = residual.model.with_other_tool(0.2)
    models["belief"] = residual.rigid.belief
    models["rigid, known"] = RigidLearner(arm.nominal, ROUGH, residual.rigid.belief)
    models["residual, known"] = ResidualLearner(arm.nominal, ROUGH, residual.model)
    models["train"] = TensorTrain.from_chain(arm.nominal, BASES)
    models["nlms"] = NLMS(arm.nominal.to_kbmap(BASES))
    return {name: (type(model), model.to_bytes()) for name, model in models.items()}


# Written down, so that collecting the tests teaches no model.
NAMES = [
    "belief",
    "kernel",
    "kernel on a map",
    "kernel, from nothing",
    "nlms",
    "recursive",
    "residual",
    "residual model",
    "residual, known",
    "rigid",
    "rigid, known",
    "tensor",
    "tensor, from nothing",
    "train",
]


def test_every_stored_model_is_damaged():
    assert sorted(stored()) == NAMES


def opened(data: bytes) -> tuple[str, dict[str, Any], dict[str, np.ndarray]]:
    _, _, length = PREFIX.unpack_from(data)
    header = json.loads(data[PREFIX.size : PREFIX.size + length])
    arrays, begin = {}, PREFIX.size + length
    for name, shape in header["arrays"].items():
        end = begin + 8 * math.prod(shape)
        arrays[name], begin = np.frombuffer(data[begin:end], dtype="<f8").reshape(shape), end
    return header["kind"], header["fields"], arrays


def closed(kind: str, fields: dict[str, Any], arrays: dict[str, np.ndarray]) -> bytes:
    """Pack data like `kbmaps.packed.pack`, with numbers valid in JSON but not in float64 in place of texts."""
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    header = json.dumps({"kind": kind, "fields": fields, "arrays": shapes})
    for text in WRONG:
        header = header.replace(json.dumps(text), text) if isinstance(text, str) else header
    payload = b"".join(array.astype("<f8").tobytes() for array in arrays.values())
    body = PREFIX.pack(MAGIC, VERSION, len(header.encode())) + header.encode() + payload
    return body + hashlib.blake2b(body, digest_size=16).digest()


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each value in nested objects and lists."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        yield (*place, key)
        yield from places(entry, (*place, key))


def refused_or_the_same(name: str, data: bytes) -> bool:
    kind, original = stored()[name]
    try:
        return kind.from_bytes(data).to_bytes() == original
    except ModelFormatError:
        return True


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
def test_fields_that_are_missing_or_wrong_are_refused(name, data):
    kind, fields, arrays = opened(stored()[name][1])
    fields = copy.deepcopy(fields)
    if not fields:
        return
    *way, last = data.draw(st.sampled_from(list(places(fields))))
    holder = functools.reduce(lambda part, key: part[key], way, fields)
    wrong = data.draw(st.sampled_from([None, *WRONG]))
    if wrong is None:
        del holder[last]
    else:
        holder[last] = wrong
    assert refused_or_the_same(name, closed(kind, fields, arrays))


DAMAGE = {
    "missing": lambda array: None,
    "shorter": lambda array: array[:-1],
    "one in another": lambda array: array[None],
    "flat": lambda array: array.ravel(),
    "of columns": lambda array: array[..., None],
    "not a number": lambda array: np.where(np.arange(array.size).reshape(array.shape) == 0, np.nan, array),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("name", NAMES)
def test_missing_or_mismatched_arrays_are_refused(name, damage):
    kind, fields, arrays = opened(stored()[name][1])
    for spoilt in arrays:
        if (damage == "not a number" and spoilt in WITH_NAN) or (damage == "shorter" and spoilt == "used"):
            continue
        wrong = DAMAGE[damage](arrays[spoilt])
        rest = {array: values for array, values in arrays.items() if array != spoilt}
        parts = rest if wrong is None else {key: wrong if key == spoilt else arrays[key] for key in arrays}
        assert refused_or_the_same(name, closed(kind, fields, parts)), spoilt


def test_numbers_invalid_in_json_are_not_written():
    with pytest.raises(ValueError, match="JSON"):
        pack("model", {"tolerance": math.inf}, {})


@pytest.mark.parametrize("name", NAMES)
def test_every_model_header_is_standard_json(name):
    data = stored()[name][1]
    _, _, length = PREFIX.unpack_from(data)
    assert json.loads(data[PREFIX.size : PREFIX.size + length], parse_constant=pytest.fail)


def test_infinite_tolerances_come_back():
    kind, data = stored()["rigid"]
    assert kind.from_bytes(data).tolerances.tool == math.inf
