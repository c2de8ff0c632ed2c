"""Levenberg-Marquardt for all least-squares problems of this package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np

from bodyschema.interfaces.records import FloatArray


class _Settings:
    # Most steps, and the relative decrease of the sum of squares that ends them: thousandths of a sigma.
    max_steps, converged = 60, 1e-7
    # Damping relative to the diagonal of the normal equations, at first and at most.
    first_damping, max_damping = 1e-4, 1e12


class Linearised(Protocol):
    """A problem at one point."""

    @property
    def squares(self) -> float:
        """The sum of squares at this point."""
        ...


P = TypeVar("P", bound=Linearised)


def minimised(problem: P, stepped: Callable[[P, float], P | None]) -> P:
    """Return the problem at the minimum of its sum of squares.

    Args:
        problem: the problem at the start.
        stepped: returns the problem after a step with the given damping; None if there is no such step.
    """
    damping = _Settings.first_damping
    for _ in range(_Settings.max_steps):
        then = stepped(problem, damping)
        if then is not None and then.squares <= problem.squares:
            gained = problem.squares - then.squares
            problem, damping = then, 0.1 * damping
            if gained <= _Settings.converged * problem.squares:
                break
        elif (damping := 10.0 * damping) > _Settings.max_damping:
            break
    return problem


def damped_step(jacobian: FloatArray, residuals: FloatArray, damping: float) -> FloatArray:
    """Return the step (p,) for residuals (n,) and their negative derivative (n, p) by the unknowns."""
    normal = jacobian.T @ jacobian
    normal.flat[:: len(normal) + 1] *= 1.0 + damping
    return np.asarray(np.linalg.solve(normal, jacobian.T @ residuals), np.float64)
