"""Doctests of the functions that a newcomer calls first; `--doctest-modules` runs them."""

from __future__ import annotations

import doctest
import inspect

import pytest

import kbmaps

CALLED_FIRST = [
    "NLMS",
    "ChainParameters",
    "ChainTolerances",
    "ExactLearner",
    "InverseKinematics",
    "JointBasis",
    "KBMap",
    "RecursiveRigidLearner",
    "RigidChain",
    "RigidLearner",
    "SupportSet",
    "TensorLearner",
    "TensorTrain",
    "align",
    "find_chain",
    "learning_bases",
    "nearest_rotation",
    "prediction_errors",
]


@pytest.mark.parametrize("name", CALLED_FIRST)
def test_what_is_called_first_shows_how(name: str) -> None:
    assert doctest.DocTestParser().get_examples(inspect.getdoc(getattr(kbmaps, name)) or "")
