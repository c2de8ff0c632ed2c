"""Scale an effect until its residual has the size asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .bullet import Bullet
from .hidden import Hidden, Kind, Site
from .motion import Motion
from .world import World, noise, residuals, whitened

PAIRS_LOOKED_AT = 150
CLOSE_ENOUGH = 0.03
MOST_ROUNDS = 12
SMALLEST = 1e-6


class NoEffect(ValueError):
    """The effect does not show at all: a joint without load, a joint that never moves."""


class Sizer:
    """Effects of a size, on one motion of one arm whose encoders scatter by `scatter` ticks."""

    def __init__(self, bullet: Bullet, nominal: World, motion: Motion, scatter: float) -> None:
        self._bullet, self._nominal = bullet, nominal
        self._motion = motion.thinned(PAIRS_LOOKED_AT)
        plain = nominal.measure(self._motion)
        self._noise = noise(nominal, plain.readings, plain.pixels, scatter)

    def scaled(self, hidden: Hidden, kind: Kind, size: float) -> Hidden:
        """Return the effect with parameters scaled so that the whitened RMS of its residual is about `size`.

        Raises:
            NoEffect: no amplitude shows.
        """
        tried: list[tuple[float, float]] = []  # logarithms of amplitude and relative size
        amplitude, best = 1.0, hidden
        for _ in range(MOST_ROUNDS):
            parameters, stopped = kind.scaled(hidden.parameters, amplitude)
            best = self.sized(replace(hidden, parameters=parameters))
            if not best.size > SMALLEST:
                raise NoEffect(f"{hidden.effect} at {hidden.where} does not show")
            off = float(np.log(best.size / size))
            if abs(off) < CLOSE_ENOUGH or (stopped and off < 0.0):
                break
            tried.append((float(np.log(amplitude)), off))
            amplitude = float(np.exp(_next(tried)))
        return best

    def sized(self, hidden: Hidden) -> Hidden:
        """Return the effect with its size filled in."""
        world = World(self._bullet, self._nominal.arm, [hidden])
        try:
            sight = world.measure(self._motion)
        finally:
            world.close()
        off = residuals(self._nominal, sight)
        in_noise = whitened(self._noise, off)
        return replace(
            hidden, size=float(np.sqrt(np.mean(in_noise**2))), rms_m=float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        )

    def shows_on(self, hidden: Hidden, rng: np.random.Generator) -> dict[str, float]:
        """Return for each joint the share of the residual's variance that it alone holds, the others given.

        Half the mean square change when this joint alone is taken from another posture, over the variance (the total
        effect of a variance-based sensitivity analysis).
        """
        world = World(self._bullet, self._nominal.arm, [hidden])
        try:
            t = self._motion.stamps
            q = self._motion.at(self._motion.shaft, t)
            as_is = residuals(self._nominal, world.standing(q, t))
            variance = np.mean(np.sum((as_is - as_is.mean(axis=0)) ** 2, axis=1))
            shares = {}
            for index, name in enumerate(self._nominal.arm.read):
                other = q.copy()
                other[:, index] = rng.permutation(q[:, index])
                seen = world.marker(other, t)[:, 2] > 0.2
                change = residuals(self._nominal, world.standing(other[seen], t[seen])) - as_is[seen]
                shares[name] = float(0.5 * np.mean(np.sum(change**2, axis=1)) / variance)
        finally:
            world.close()
        return shares


def _next(tried: list[tuple[float, float]]) -> float:
    """Return the logarithm of the next amplitude: between the nearest from below and above, else in proportion."""
    below = max((point for point in tried if point[1] < 0.0), default=None)
    above = min((point for point in tried if point[1] > 0.0), default=None)
    if below is None or above is None:
        return tried[-1][0] - tried[-1][1]
    part = np.clip(below[1] / (below[1] - above[1]), 0.15, 0.85)
    return below[0] + float(part) * (above[0] - below[0])


def drawn(kind: Kind, effect: str, site: Site, rng: np.random.Generator) -> Hidden:
    """Return the effect with parameters of an initial amplitude."""
    drivers = kind.drivers(site) if kind.drivers is not None else ()
    return Hidden(effect, site.where, site.source, kind.draw(site, rng), kind.sign, kind.outside, drivers)
