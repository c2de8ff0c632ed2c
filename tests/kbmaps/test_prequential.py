from __future__ import annotations

import math

import numpy as np
import pytest

from kbmaps import PrequentialComparison, Recent, ShapeError

TRUSTED = ("rigid", "bent")


def squares(measured: np.ndarray, offsets: tuple[float, float]) -> dict[str, float]:
    """Return the squared errors of two models that have these offsets along x."""
    return {
        name: float(np.square(measured + np.array([offset, 0.0, 0.0])).sum())
        for name, offset in zip(TRUSTED, offsets, strict=True)
    }


def contest(rigid: float, bent: float, pairs: int, noise: float = 0.005, seed: int = 0) -> PrequentialComparison:
    rng, held = np.random.default_rng(seed), PrequentialComparison()
    for _ in range(pairs):
        held.add(squares(noise * rng.normal(size=3), (rigid, bent)))
    return held


def test_the_more_trusted_of_two_equal_models_answers():
    assert contest(0.001, 0.001, 200).best(TRUSTED, "none") == "rigid"


def test_clearly_better_model_answers_despite_less_trust():
    assert contest(0.01, 0.001, 50).best(TRUSTED, "none") == "bent"


def test_without_noise_an_exact_model_answers():
    assert contest(0.01, 0.0, 50, noise=0.0).best(TRUSTED, "none") == "bent"


def test_better_model_is_found_below_common_noise():
    chosen = [contest(0.003, 0.001, 400, noise=0.005, seed=seed).best(TRUSTED, "none") for seed in range(20)]
    assert chosen.count("bent") >= 18


def test_noise_alone_seldom_unseats_the_more_trusted_model():
    chosen = []
    for seed in range(100):
        rng, held = np.random.default_rng(seed), PrequentialComparison()
        for _ in range(100):
            held.add(dict(zip(TRUSTED, np.square(rng.normal(size=2)).tolist(), strict=True)))
        chosen.append(held.best(TRUSTED, "none"))
    assert chosen.count("bent") <= 10  # of 100, with noise that the two do not even share


@pytest.mark.parametrize("pairs", [0, 2])
def test_answering_model_continues_with_too_few_pairs(pairs):
    assert contest(0.01, 0.001, pairs).best(TRUSTED, "bent") == "bent"


def test_a_prediction_that_is_not_finite_is_none():
    held = PrequentialComparison()
    for _ in range(20):
        held.add({"rigid": math.nan, "bent": 0.1})
    assert held.best(TRUSTED, "rigid") == "bent"


def test_common_outliers_do_not_hide_the_better_model():
    rng, held = np.random.default_rng(1), PrequentialComparison()
    for k in range(300):
        measured = 0.002 * rng.normal(size=3) + (0.3 * rng.normal(size=3) if k % 7 == 0 else 0.0)
        held.add(squares(measured, (0.004, 0.001)))
    assert held.best(TRUSTED, "none") == "bent"


def test_old_errors_do_not_count():
    held, rng = contest(0.001, 0.02, 300), np.random.default_rng(1)
    for _ in range(800):
        held.add(squares(0.005 * rng.normal(size=3), (0.02, 0.001)))
    assert held.best(TRUSTED, "none") == "bent"


def test_forgotten_model_is_compared_on_new_pairs_only():
    held = contest(0.02, 0.001, 50)
    held.forget("rigid")
    assert held.best(TRUSTED, "none") == "bent"
    rng = np.random.default_rng(1)
    for _ in range(10):
        held.add(squares(0.005 * rng.normal(size=3), (0.001, 0.001)))
    assert held.best(TRUSTED, "none") == "rigid"


def test_a_contest_goes_on_from_its_errors():
    held = contest(0.01, 0.001, 350)
    held.add({"rigid": math.nan, "bent": 1.0})
    again = PrequentialComparison(held.errors, held.pairs)
    for one in (held, again):
        one.add({"rigid": 1.0})
    assert again.pairs == held.pairs
    for name in TRUSTED:
        np.testing.assert_array_equal(again.errors[name], held.errors[name])


def test_errors_of_different_numbers_of_pairs_are_refused():
    with pytest.raises(ShapeError):
        PrequentialComparison({"rigid": [0.1], "bent": [0.1, 0.2]})


@pytest.mark.parametrize("failing", [5, 10, 40])
def test_a_model_that_fails_lately_does_not_answer(failing: int):
    """Check recent failures, however good the model was before and however large its errors are now."""
    held = PrequentialComparison()
    for k in range(100):
        held.add({"rigid": 0.002**2, "bent": 0.0005**2 if k < 100 - failing else 0.1**2})
    assert held.best(TRUSTED, "none") == "rigid"


def test_recent_errors_use_the_same_pairs_for_all():
    held = PrequentialComparison()
    for k in range(60):
        held.add({"rigid": 0.004**2 if k < 30 else 0.001**2} | ({} if k < 40 else {"bent": 0.002**2}))
    assert held.recent("rigid") == Recent(20, {"rigid": pytest.approx(0.001), "bent": pytest.approx(0.002)})


def test_recent_errors_omit_models_with_few_pairs():
    held = PrequentialComparison()
    for k in range(60):
        held.add({"rigid": 0.001**2} | ({} if k < 55 else {"bent": 0.002**2}))
    assert held.recent("rigid") == Recent(50, {"rigid": pytest.approx(0.001)})
    assert held.recent("bent") == Recent(5, {"rigid": pytest.approx(0.001), "bent": pytest.approx(0.002)})


def test_recent_errors_are_empty_before_any_pair():
    assert PrequentialComparison().recent("rigid") == Recent(0, {})


def test_neighbours_that_fare_alike_count_as_one():
    """Check that one stretch of a path where a model does better is no proof, however many pairs were taken there."""
    held = PrequentialComparison()
    for k in range(60):
        held.add({"rigid": 1.0 + 0.01 * k, "bent": 1.0})
    for _ in range(60):
        held.add({"rigid": 1.0, "bent": 1.0})
    assert held.best(TRUSTED, "none") == "rigid"


def test_late_model_is_compared_on_pairs_not_learnt():
    held = contest(0.01, 0.001, 50)
    for square in held.errors["rigid"]:
        held.add({"rigid": float(square)})
    held.add_late("bent", [1e-8] * 160)
    assert held.best(TRUSTED, "none") == "bent"


def test_batched_errors_count_like_single_errors():
    rng = np.random.default_rng(3)
    values = {name: rng.random(250) for name in TRUSTED}
    together, each = PrequentialComparison(), PrequentialComparison()
    for begin in range(0, 250, 25):
        together.add({name: squared[begin : begin + 25] for name, squared in values.items()})
    for k in range(250):
        each.add({name: squared[k] for name, squared in values.items()})
    assert together.pairs == each.pairs
    np.testing.assert_array_equal(together.errors["bent"], each.errors["bent"])


def test_as_many_pairs_are_asked_of_each_model():
    with pytest.raises(ShapeError, match="squares"):
        PrequentialComparison().add({"rigid": [0.1, 0.2], "bent": [0.1]})
