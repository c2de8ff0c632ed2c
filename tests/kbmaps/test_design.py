from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted_chains import bases_for, random_q

from kbmaps import JointBasis
from kbmaps.maps.design import Design
from kbmaps.maps.exact import nearest_solution
from kbmaps.maps.factor import ShiftedGram

seeds = st.integers(0, 2**32 - 1)
kinds = st.text("RP", min_size=1, max_size=4)


def planted(rng: np.random.Generator, joint_kinds: str, pairs: int) -> tuple[Design, np.ndarray, np.ndarray]:
    """Return a design, its matrix and its scaled targets, computed directly."""
    choices = [bases_for(joint_kinds), bases_for(joint_kinds, 20)]
    if "P" not in joint_kinds:
        choices.append((JointBasis.bernstein(1.0, 0.2),) * len(joint_kinds))
    bases = choices[rng.integers(len(choices))]
    q, x, weights = random_q(rng, joint_kinds, pairs, 80), rng.normal(size=(pairs, 3)), rng.uniform(0.2, 5.0, pairs)
    design = Design(bases, 3)
    for part in np.array_split(np.arange(pairs), 3):
        design.add(q[part], x[part], weights[part])
    rows = np.ones((pairs, 1))
    for k, basis in enumerate(bases):
        rows = (rows[:, :, None] * basis.weights(q[:, k])[:, None, :]).reshape(pairs, -1)
    return design, rows * np.sqrt(weights)[:, None], x * np.sqrt(weights)[:, None]


@given(seed=seeds, joint_kinds=kinds, times=st.sampled_from([0.5, 1.0, 1.5, 12.0]))
def test_the_gram_matrix_is_that_of_the_rows(seed, joint_kinds, times):
    rng = np.random.default_rng(seed)
    unknowns = int(np.prod([3 if kind == "R" else 2 for kind in joint_kinds]))
    design, rows, _ = planted(rng, joint_kinds, max(1, int(times * unknowns)))
    expected = rows.T @ rows if design.overdetermined else rows @ rows.T
    np.testing.assert_allclose(
        np.triu(design.gram()), np.triu(expected), rtol=0, atol=1e-13 * np.abs(expected).max() * len(rows) ** 0.5
    )


@given(seed=seeds, joint_kinds=kinds, pairs=st.integers(1, 700))
def test_products_are_those_of_the_rows(seed, joint_kinds, pairs):
    rng = np.random.default_rng(seed)
    design, rows, targets = planted(rng, joint_kinds, pairs)
    coefficients, values = rng.normal(size=(rows.shape[1], 3)), rng.normal(size=(pairs, 3))
    atol = 1e-13 * np.abs(rows).max() * pairs
    np.testing.assert_allclose(design.rows(), rows, rtol=0, atol=atol)
    np.testing.assert_allclose(design.times(coefficients), rows @ coefficients, rtol=0, atol=atol)
    np.testing.assert_allclose(design.errors(coefficients), targets - rows @ coefficients, rtol=0, atol=atol)
    np.testing.assert_allclose(design.transposed_times(values), rows.T @ values, rtol=0, atol=atol)


@pytest.mark.parametrize("pairs", [9, 40])
def test_pairs_with_singular_gram_are_solved_by_rows(pairs):
    rng = np.random.default_rng(5)
    design = Design(bases_for("RR"), 3)
    q = random_q(rng, "RR", pairs, 0.5)
    truth = rng.normal(size=(9, 3))
    design.add(q, np.zeros((pairs, 3)), np.ones(pairs))
    gram = ShiftedGram(design.gram())
    assert not gram.factorise(0.0) or gram.rcond < 1e-15
    rows = design.rows()
    found = nearest_solution(design, rows @ truth)
    assert np.abs(found - truth).max() < 1e-15 * np.linalg.cond(rows)
