"""The two implementations of the innermost loops agree."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_chain, random_map, random_q
from rough_arms import ROUGH, rough_arm

from kbmaps import NLMS, ChainParameters, KBMap, KBMapsError, RecursiveRigidLearner, SettingError, kernels_in_use
from kbmaps.maps import code_path

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=6)
needs_both = pytest.mark.skipif(
    len(code_path.available()) < 2, reason="no compiled kernels; to run it: apt-get install gcc"
)


def on_both_paths(make: Callable[[], object]) -> list[object]:
    results = []
    for path in ("numpy", "compiled"):
        with code_path.using(path):
            results.append(make())
    return results


def pose_map(rng: np.random.Generator, joint_kinds: str) -> KBMap:
    bases = bases_for(joint_kinds)
    return KBMap(bases, rng.normal(size=(12, *(basis.size for basis in bases))))


@needs_both
@given(seed=seeds, joint_kinds=kinds, rows=st.sampled_from([None, 0, 1, 4, 5, 16, 39]))
def test_predictions_and_derivatives_agree_to_rounding(seed, joint_kinds, rows):
    rng = np.random.default_rng(seed)
    given_map = pose_map(rng, joint_kinds)
    q = random_q(rng, joint_kinds, 1 if rows is None else rows, 170)
    q = q[0] if rows is None else q
    one, other = on_both_paths(lambda: KBMap(given_map.bases, given_map.net))
    for ask in ("predict", "orientation", "jacobian"):
        expected, got = getattr(one, ask)(q), getattr(other, ask)(q)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max(initial=0.0)))


@needs_both
@given(seed=seeds, joint_kinds=kinds, mu0=st.floats(0.05, 1.95))
def test_learning_and_replaying_agree_to_rounding(seed, joint_kinds, mu0):
    rng = np.random.default_rng(seed)
    start = random_map(rng, bases_for(joint_kinds))
    q, x = random_q(rng, joint_kinds, 90, 80), rng.normal(size=(90, 3))
    order = rng.integers(0, 90, 130)
    one, other = on_both_paths(lambda: NLMS(start, mu0))
    for learner in (one, other):
        learner.learn(q[0], x[0])
        learner.replay(q, x, order)
    np.testing.assert_allclose(other.map.net, one.map.net, rtol=0, atol=1e-11)


@needs_both
@given(seed=seeds, joint_kinds=kinds, sigma=st.sampled_from([None, 0.004]), jump=st.sampled_from([0.0, 0.3]))
def test_recursive_rigid_learners_agree_to_rounding(seed, joint_kinds, sigma, jump):
    rng = np.random.default_rng(seed)
    arm = rough_arm(rng, joint_kinds)
    q, x = arm.pairs(rng, 25, 0.004)
    x[-1] += jump
    one, other = on_both_paths(lambda: RecursiveRigidLearner(arm.nominal, ROUGH, noise=0.01))
    for learner in (one, other):
        learner.learn(q[0], x[0], sigma)
        learner.learn(q[1:], x[1:], sigma)
    np.testing.assert_allclose(other.change, one.change, rtol=0, atol=1e-9)
    assert other.noise == pytest.approx(one.noise, rel=1e-7)
    expected, got = one.estimate(q), other.estimate(q)
    np.testing.assert_allclose(got.x, expected.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.sigma, expected.sigma, rtol=1e-5, atol=1e-9)


@needs_both
@given(seed=seeds, joint_kinds=kinds, size=st.sampled_from([0.0, 1e-4, 0.5]), rows=st.sampled_from([0, 1, 7]))
def test_changed_chain_positions_and_derivatives_agree_to_rounding(seed, joint_kinds, size, rows):
    rng = np.random.default_rng(seed)
    chain, q = random_chain(rng, joint_kinds), random_q(rng, joint_kinds, rows, 170)
    one, other = on_both_paths(lambda: ChainParameters(chain))
    change = size * rng.normal(size=one.size)
    for expected, got in zip(one.linearised(change, q), other.linearised(change, q), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.positions(change, q), one.positions(change, q), rtol=0, atol=1e-12)


@needs_both
def test_the_derivatives_by_some_parameters_are_those_columns():
    rng = np.random.default_rng(0)
    chain, q = random_chain(rng, "RPR"), random_q(rng, "RPR", 5, 170)
    change, columns = rng.normal(size=ChainParameters(chain).size), np.array([1, 7, 20])

    def chosen() -> np.ndarray:
        x, jacobian = np.empty((5, 3)), np.empty((5, 3, 3))
        ChainParameters(chain).lineariser(columns)(change, q, x, jacobian)
        return jacobian

    every = ChainParameters(chain).linearised(change, q)[1]
    for jacobian in on_both_paths(chosen):
        np.testing.assert_allclose(jacobian, every[:, :, columns], rtol=0, atol=1e-12)


@pytest.mark.parametrize("path", code_path.available())
@pytest.mark.parametrize("columns", [[7, 1], [1, 1], [-1, 0], [[1, 7]]])
def test_columns_that_do_not_ascend_are_refused(path, columns):
    with code_path.using(path), pytest.raises(SettingError, match="columns must ascend"):
        ChainParameters(random_chain(np.random.default_rng(0), "RPR")).lineariser(np.array(columns))


@pytest.mark.parametrize("path", code_path.available())
@pytest.mark.parametrize("kind", ["f4", "i8", ">f8"])
def test_any_numbers_are_linearised(path, kind):
    with code_path.using(path):
        parameters = ChainParameters(random_chain(np.random.default_rng(0), "RPR"))
    q, change = np.array([[1, 0, -1], [0, 1, 2]]), np.zeros(parameters.size)
    expected, got = parameters.linearised(change, q.astype(float)), parameters.linearised(change, q.astype(kind))
    for one, other in zip(expected, got, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-6)


BAD_VECTORS = [
    [0.1, math.nan],
    [0.1, math.inf],
    [0.1],
    np.zeros((1, 1, 2)),
    np.zeros((2, 2))[:, :1],
    0.5,
    np.array([0.0, -math.inf], dtype=np.float32),
]


def complaint(call: Callable[[object], object], argument: object) -> tuple[type[Exception], str]:
    with pytest.raises(KBMapsError) as caught:
        call(argument)
    return caught.type, str(caught.value)


@needs_both
@pytest.mark.parametrize("bad", BAD_VECTORS, ids=str)
@pytest.mark.parametrize("ask", ["predict", "jacobian", "learn", "learn to"])
def test_bad_input_is_refused_in_the_same_words(ask, bad):
    start = random_map(np.random.default_rng(1), bases_for("RR"))

    def call(path: str) -> tuple[type[Exception], str]:
        with code_path.using(path):
            kbmap, learner = KBMap(start.bases, start.net), NLMS(start)
        calls = {
            "predict": kbmap.predict,
            "jacobian": kbmap.jacobian,
            "learn": lambda q: learner.learn(q, np.zeros(3)),
            "learn to": lambda x: learner.learn(np.zeros(2), x),
        }
        refused = complaint(calls[ask], bad)
        assert learner.map.digest == start.digest
        return refused

    assert call("compiled") == call("numpy")


BAD_PAIRS = {
    **{f"q: {bad}": (bad, np.zeros(3), None) for bad in BAD_VECTORS},
    **{f"x: {bad}": (np.zeros(2), bad, None) for bad in BAD_VECTORS},
    **{
        f"sigma: {bad}": (np.zeros(2), np.zeros(3), bad)
        for bad in (0.0, -0.0, -1.0, math.nan, math.inf, [0.1, 0.1], "x")
    },
    "words": (["a", "b"], np.zeros(3), None),
    "a sum without end": (np.full(2, 1e308), np.zeros(3), None),
    "q and x both bad": (np.array([0.1, math.nan]), np.array([math.nan, 0.0, 0.0]), -1.0),
    "rows beside a vector": (np.zeros((2, 2)), np.zeros(3), None),
}


@needs_both
@pytest.mark.parametrize("bad", BAD_PAIRS.values(), ids=BAD_PAIRS)
def test_rigid_learners_refuse_bad_pairs_with_same_message(bad):
    arm = rough_arm(np.random.default_rng(3), "RR")

    def call(path: str) -> tuple[type[Exception], str]:
        with code_path.using(path):
            learner = RecursiveRigidLearner(arm.nominal, ROUGH)
        learner.learn(np.zeros(2), np.zeros(3))
        before = learner.to_bytes()
        refused = complaint(lambda pair: learner.learn(*pair), bad)
        assert learner.to_bytes() == before
        return refused

    assert call("compiled") == call("numpy")


CONVERSIONS = pytest.mark.parametrize(
    "convert",
    [list, tuple, np.float32, lambda q: q.astype(">f8"), lambda q: np.repeat(q, 2)[::2], lambda q: q.astype(int)],
    ids=["list", "tuple", "float32", "big-endian", "strided", "int"],
)


@pytest.mark.usefixtures("kernel_path")
@CONVERSIONS
def test_rigid_learner_accepts_all_numpy_inputs(convert):
    arm = rough_arm(np.random.default_rng(4), "RRR")
    one, other = (RecursiveRigidLearner(arm.nominal, ROUGH) for _ in range(2))
    q, x = np.array([1.0, -2.0, 0.0]), np.array([1.0, 0.0, -1.0])
    one.learn(q, x, 0.5)
    other.learn(convert(q), convert(x), np.float32(0.5))
    assert other.to_bytes() == one.to_bytes()


@pytest.mark.usefixtures("kernel_path")
@CONVERSIONS
def test_map_accepts_all_numpy_inputs(convert):
    kbmap = random_map(np.random.default_rng(2), bases_for("RRR"))
    q = np.array([1.0, -2.0, 0.0])
    fresh = KBMap(kbmap.bases, kbmap.net)
    np.testing.assert_array_equal(fresh.predict(convert(q)), fresh.predict(q))


@needs_both
def test_threads_share_a_compiled_map():
    with code_path.using("compiled"):
        kbmap = random_map(np.random.default_rng(3), bases_for("RRRR"))
    q = random_q(np.random.default_rng(4), "RRRR", 3000, 80)
    expected, results = kbmap.predict(q), [None] * 4

    def work(place: int) -> None:
        results[place] = kbmap.predict(q)

    threads = [threading.Thread(target=work, args=(place,)) for place in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(result, expected) for result in results)


def test_the_environment_can_ask_for_numpy():
    code = "import kbmaps; print(kbmaps.kernels_in_use())"
    environment = os.environ | {"BODYSCHEMA_PURE": "1"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "numpy"


def test_a_path_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setattr(code_path, "_available", None)
    with pytest.raises(SettingError, match="C compiler"), code_path.using("compiled"):
        pass


def test_the_path_is_chosen_for_a_block_only():
    before = kernels_in_use()
    with code_path.using("numpy"):
        assert kernels_in_use() == "numpy"
    assert kernels_in_use() == before


# --- buffers that Python's own checks would not have let through


def net_of(joints: int, points: int, empty: Callable[[object], object] = np.empty):
    arrays = np.zeros(2 * joints), np.zeros(9 * joints), np.zeros(joints), np.zeros(points)
    return import_module("kbmaps._kernels").Net(*arrays, np.asarray, np.asarray, empty)


REPLAYED = {"q": np.zeros((4, 2)), "x": np.zeros((4, 3)), "order": np.array([0, 3]), "mu0": np.ones(2)}


@needs_both
@pytest.mark.parametrize(
    "wrong",
    [
        {"q": np.zeros((4, 1))},
        {"q": np.zeros((4, 3))},
        {"q": np.zeros(8)},
        {"q": np.zeros((8, 2))[::2]},
        {"q": np.zeros((4, 2), np.float32)},
        {"q": b"12345678" * 8},
        {"q": np.zeros(())},
        {"x": np.zeros((4, 2))},
        {"x": np.zeros((3, 3))},
        {"x": np.zeros((4, 3, 1))},
        {"x": np.zeros(12)},
        {"order": np.array([0, 4])},
        {"order": np.array([0, -1])},
        {"order": np.array([0, 2**62])},
        {"order": np.array([0, 3], np.int32)},
        {"order": np.array([0, 3], np.uint64)},
        {"order": np.array([0, 3], float)},
        {"order": np.array([[0, 3]])},
        {"order": [0, 3]},
        {"mu0": np.ones(1)},
        {"mu0": np.ones(3)},
    ],
    ids=str,
)
def test_a_replay_refuses_buffers_that_do_not_fit(wrong: dict[str, object]) -> None:
    net = net_of(2, 27)
    net.replay(*REPLAYED.values())
    with pytest.raises((TypeError, BufferError)):
        net.replay(*(REPLAYED | wrong).values())


@needs_both
@pytest.mark.parametrize(("joints", "points"), [(2, 0), (2, 8), (2, 26), (3, 9), (50, 2**10), (64, 2**10), (41, 3**6)])
def test_a_net_refuses_planes_that_do_not_fit(joints: int, points: int) -> None:
    with pytest.raises(TypeError, match=f"{joints} joints cannot have {points} control points"):
        net_of(joints, points)


@needs_both
def test_results_are_not_written_into_a_smaller_array() -> None:
    net = net_of(2, 27, lambda _: np.zeros(2))
    for ask in (net.outputs, net.derivatives):
        with pytest.raises(TypeError, match="another size"):
            ask(np.zeros((30, 2)), 0, 3)
