from __future__ import annotations

import hashlib
import json
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_map

from kbmaps import KBMap, ModelFormatError
from kbmaps.maps.serial import MAGIC

MAP = random_map(np.random.default_rng(7), bases_for("RPR")).with_metadata({"robot": "left arm", "pairs": "612"})
STORED = MAP.to_bytes()


def forged(header: bytes, net: bytes = b"") -> bytes:
    """Return a byte string with a valid checksum around an arbitrary header."""
    body = struct.pack("<8sII", MAGIC, 1, len(header)) + header + net
    return body + hashlib.blake2b(body, digest_size=16).digest()


# One character of each kind: the table of all of Unicode takes two seconds to build.
texts = st.text(st.sampled_from('aZ9 "\\\n\0\x7fé\u0301漢\ufeff🤖'), max_size=20)


@given(kinds=st.text("RP", min_size=1, max_size=5), seed=st.integers(0, 1000), text=texts)
def test_map_round_trips_through_bytes_bit_for_bit(kinds, seed, text):
    kbmap = random_map(np.random.default_rng(seed), bases_for(kinds)).with_metadata({"note": text})
    back = KBMap.from_bytes(kbmap.to_bytes())
    assert back.bases == kbmap.bases
    assert back.net.tobytes() == kbmap.net.tobytes()
    assert back.metadata == kbmap.metadata
    assert back.digest == kbmap.digest


def test_a_map_with_orientation_survives_the_round_trip():
    kbmap = KBMap(MAP.bases, np.random.default_rng(1).normal(size=(12, *MAP.net.shape[1:])))
    assert KBMap.from_bytes(kbmap.to_bytes()).has_orientation


@given(position=st.integers(0, len(STORED) - 1), flip=st.integers(1, 255))
def test_a_single_changed_byte_is_noticed(position, flip):
    damaged = bytearray(STORED)
    damaged[position] ^= flip
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(bytes(damaged))


@given(length=st.integers(0, len(STORED) - 1))
def test_truncated_bytes_are_noticed(length):
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(STORED[:length])


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused(data):
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(data)


@given(st.binary(max_size=300))
def test_arbitrary_header_with_valid_checksum_is_refused(header):
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(forged(header))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)


@given(bases=json_values, outputs=json_values, metadata=json_values, net=st.binary(max_size=80))
def test_a_header_of_arbitrary_values_is_refused(bases, outputs, metadata, net):
    header = json.dumps({"bases": bases, "outputs": outputs, "metadata": metadata}).encode()
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(forged(header, net))


@pytest.mark.parametrize(
    ("bases", "outputs"),
    [
        ([{"kind": "trigonometric", "parameters": {}}] * 40, 3),
        ([{"kind": "trigonometric", "parameters": {}}] * 20, 3),
        ([{"kind": "trigonometric", "parameters": {}}], 10**30),
        ([{"kind": "bernstein", "parameters": {"alpha": 1.57, "centre": 0.0}}], 3),
        ([{"kind": "bernstein", "parameters": {"alpha": 1.0, "centre": float("nan")}}], 3),
        ([{"kind": "orthonormal", "parameters": {"low": 1.0, "high": -1.0, "scale": 1.0}}], 3),
        ([{"kind": "pickle", "parameters": {}}], 3),
    ],
)
def test_impossible_map_description_is_refused_without_allocating(bases, outputs):
    data = forged(json.dumps({"bases": bases, "outputs": outputs, "metadata": {}}).encode(), bytes(72))
    tracemalloc.start()
    try:
        with pytest.raises(ModelFormatError):
            KBMap.from_bytes(data)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000  # bytes
    finally:
        tracemalloc.stop()


def test_a_deeply_nested_header_is_refused():
    with pytest.raises(ModelFormatError):
        KBMap.from_bytes(forged(b"[" * 100_000))


def test_nan_in_the_net_is_refused():
    header = json.dumps({"bases": [{"kind": "trigonometric", "parameters": {}}], "outputs": 3, "metadata": {}}).encode()
    with pytest.raises(ModelFormatError, match="NaN"):
        KBMap.from_bytes(forged(header, np.full(9, np.nan).tobytes()))


def test_another_version_is_named():
    body = STORED[:8] + struct.pack("<I", 9) + STORED[12:]
    with pytest.raises(ModelFormatError, match="version 9"):
        KBMap.from_bytes(body)
