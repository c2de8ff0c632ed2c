"""Motions of the arm: guided by hand in small steps through the cameras' view, or to poses far apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from .arrays import BoolArray, FloatArray, IntArray

Style = Literal["walk", "stepped", "held"]
STYLES: tuple[Style, ...] = ("walk", "stepped", "held")
Visible = Callable[[FloatArray], BoolArray]

STEP_RAD = np.radians([1.2, 2.8])
SEGMENT_RAD = np.radians([1.0, 3.0])
FINE = 8  # instants between two knots of the path
PAIRS_PER_REGION = 130
STEP_S, READ_AFTER_S = 0.03, 0.03  # a stepped walk: a quick step, then read


@dataclass(frozen=True)
class Motion:
    """A path of the motor shafts, and when it is read.

    Attributes:
        t: instants of the whole path, also where nothing is recorded [s], shape (f,); the first pair is read at 0.
        shaft: positions at those instants, after the gears and free of any error [rad or m], shape (f, d).
        stamps: when pairs are read [s], shape (n,).
        segment: number of the run of pairs each belongs to, shape (n,).
        move_s, rest_s: duration of every move, and time between its end and the reading; None in a walk without
            rests.
    """

    style: Style
    t: FloatArray
    shaft: FloatArray
    stamps: FloatArray
    segment: IntArray
    move_s: float | None
    rest_s: float | None

    def thinned(self, count: int) -> Motion:
        """Return the same path, read at only `count` of the stamps, evenly chosen."""
        chosen = np.unique(np.linspace(0, len(self.stamps) - 1, count).astype(int))
        return replace(self, stamps=self.stamps[chosen], segment=self.segment[chosen])

    def at(self, values: FloatArray, t: FloatArray) -> FloatArray:
        """Interpolate the columns of `values`, given along the whole path, at the times `t`, shape (len(t), d)."""
        return np.column_stack([np.interp(t, self.t, column) for column in values.T])


def move(
    rng: np.random.Generator, style: Style, ranges: FloatArray, pairs: int, visible: Visible, *, rests: bool = False
) -> Motion:
    """Return a motion with `pairs` pairs that are all visible.

    Args:
        ranges: lower and upper end of each joint's range [rad or m], shape (d, 2).
        visible: returns a mask of the shaft positions (n, d) at which the cameras see the marker.
        rests: of a walk, whether joints that do not lead stand still.
    """
    if style == "held":
        return _held(rng, ranges, pairs, visible)
    return _Walk(rng, ranges, visible, rests).motion(style, pairs)


def narrowed(
    rng: np.random.Generator, ranges: FloatArray, visible: Visible, reach: float, still: Sequence[int]
) -> FloatArray:
    """Return the ranges (d, 2) cut to `reach` of their widths around a visible posture, and to zero for `still`."""
    centre = _Postures(rng, ranges, visible).draw()
    width = reach * np.ptp(ranges, axis=1)
    lower = np.clip(centre - 0.5 * width, ranges[:, 0], ranges[:, 1] - width)
    lower[list(still)], width[list(still)] = centre[list(still)], 0.0
    return np.column_stack([lower, lower + width])


class _Postures:
    """Visible postures anywhere in the joints' range."""

    def __init__(self, rng: np.random.Generator, ranges: FloatArray, visible: Visible) -> None:
        self._rng, self._ranges, self._visible = rng, ranges, visible
        self._stock: list[FloatArray] = []

    def draw(self) -> FloatArray:
        for _ in range(200):
            if self._stock:
                return self._stock.pop()
            many = self._rng.uniform(self._ranges[:, 0], self._ranges[:, 1], (64, len(self._ranges)))
            self._stock = list(many[self._visible(many)])
        raise ValueError("the cameras see the marker hardly anywhere")


class _Walk:
    """Knots of a walk: the hand leads the arm from posture to posture, a few joints at a time."""

    def __init__(self, rng: np.random.Generator, ranges: FloatArray, visible: Visible, rests: bool) -> None:
        self._rng, self._ranges, self._visible, self._rests = rng, ranges, visible, rests
        self._postures = _Postures(rng, ranges, visible)
        self._q: list[FloatArray] = []
        self._segment: list[int] = []  # -1 where no pair is read
        self._jump: list[bool] = []  # whether the arm was carried here from elsewhere, unseen
        self._last: FloatArray | None = None
        self._runs = 0

    def motion(self, style: Style, pairs: int) -> Motion:
        regions = max(2, round(pairs / PAIRS_PER_REGION))
        found = 0
        for region in range(regions):
            found += self._region(pairs * (region + 1) // regions - found)
        segment = np.array(self._segment)
        t, q, read = self._timed(style, np.array(self._q), segment >= 0, np.array(self._jump))
        fine = _refined(t)
        quick = (STEP_S, READ_AFTER_S) if style == "stepped" else (None, None)
        return Motion(
            style, fine - read[0], PchipInterpolator(t, q)(fine), read - read[0], segment[segment >= 0], *quick
        )

    def _region(self, pairs: int) -> int:
        """Walk until `pairs` pairs were seen."""
        here = self._postures.draw()
        self._last, self._runs = None, self._runs + 1
        found = self._add(here, seen=True, jump=True)
        while found < pairs:
            way = self._steps(here, self._next_target(here))
            for q, seen in zip(way, self._visible(way), strict=True):
                found += self._add(q, seen=bool(seen), jump=False)
                here = q
                if found >= pairs:
                    break
        return found

    def _next_target(self, here: FloatArray) -> FloatArray:
        """Return a visible posture with some of the joints elsewhere."""
        for _ in range(20):
            leads = self._rng.random(len(here)) < 0.6
            target = np.where(leads, self._postures.draw(), here)
            if leads.any() and self._visible(target[None])[0]:
                return target
        return self._postures.draw()

    def _steps(self, here: FloatArray, target: FloatArray) -> FloatArray:
        """Return a curved path from `here` to `target` in steps of the joint-space norm, without `here`."""
        distance = np.linalg.norm(target - here)
        reach = np.cumsum(self._rng.uniform(STEP_RAD[0], STEP_RAD[1], int(distance / STEP_RAD[0]) + 2))
        s = np.append(reach[reach < distance - STEP_RAD[0]], distance) / distance
        bow = self._rng.normal(0.0, 0.12 * distance, len(here)) / np.sqrt(len(here))
        if self._rests:
            bow[target == here] = 0.0
        way = here + s[:, None] * (target - here) + np.sin(np.pi * s)[:, None] * bow
        return np.clip(way, self._ranges[:, 0], self._ranges[:, 1])

    def _add(self, q: FloatArray, *, seen: bool, jump: bool) -> int:
        """Append a knot; return 1 if it gives a pair."""
        step = SEGMENT_RAD.mean() if self._last is None else float(np.linalg.norm(q - self._last))
        paired = seen and step >= SEGMENT_RAD[0]
        if paired:
            self._runs += int(step > SEGMENT_RAD[1])
            self._last = q
        self._q.append(q)
        self._segment.append(self._runs - 1 if paired else -1)
        self._jump.append(jump)
        return int(paired)

    def _timed(
        self, style: Style, q: FloatArray, paired: BoolArray, jump: BoolArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return times and positions of the path's knots, and the stamps of the pairs."""
        step = np.linalg.norm(np.diff(q, axis=0, prepend=q[:1]), axis=1)
        speed = np.clip(np.exp(np.log(9.0) + _slow_noise(self._rng, len(q), 0.3)), 5.0, 15.0)
        lasts = np.maximum(step / STEP_RAD.mean(), 0.5) / speed
        if style == "stepped":
            lasts = np.maximum(lasts, STEP_S + 1.1 * READ_AFTER_S)
        lasts[jump] = 1.0 + step[jump] / 0.8
        pause = np.where((self._rng.random(len(q)) < 0.01) | jump, self._rng.uniform(0.4, 3.0, len(q)), 0.0)
        pause[0] = lasts[0] = 0.5
        pause[-1] = 0.0
        arrive = np.cumsum(lasts + np.roll(pause, 1))
        if style == "walk":
            before, after = arrive - lasts, arrive
            rests = np.roll(pause, 1) > 0.0
            t, order = _sorted_unique(np.concatenate([after, before[rests]]))
            return t, np.concatenate([q, np.roll(q, 1, axis=0)[rests]])[order], arrive[paired]
        begin, end = arrive - READ_AFTER_S - STEP_S, arrive - READ_AFTER_S
        begin[jump] = arrive[jump] - lasts[jump] + READ_AFTER_S
        begin[0] = arrive[0] - 2.0 * READ_AFTER_S
        t, order = _sorted_unique(np.concatenate([begin, end, arrive]))
        return t, np.concatenate([np.vstack([q[:1], q[:-1]]), q, q])[order], arrive[paired]


def _held(rng: np.random.Generator, ranges: FloatArray, pairs: int, visible: Visible) -> Motion:
    """Return static poses far apart: a move of all joints of constant duration, a rest, a reading, a wait."""
    postures = _Postures(rng, ranges, visible)
    q = np.array([postures.draw() for _ in range(pairs)])
    lasts, rest = float(rng.uniform(0.7, 1.6)), float(rng.uniform(0.3, 0.9))
    stamps = np.cumsum(rng.uniform(0.1, 1.0, pairs) + lasts + rest)
    begin, end = stamps - rest - lasts, stamps - rest
    t, order = _sorted_unique(np.concatenate([begin, end, stamps]))
    knots = np.concatenate([np.vstack([q[:1], q[:-1]]), q, q])[order]
    fine = _refined(t)
    shaft, first = PchipInterpolator(t, knots)(fine), stamps[0]
    return Motion("held", fine - first, shaft, stamps - first, np.arange(pairs), lasts, rest)


def _slow_noise(rng: np.random.Generator, count: int, sigma: float) -> FloatArray:
    """Return noise that changes over about twenty knots."""
    white, out, value = rng.normal(0.0, sigma * 0.3, count), np.empty(count), 0.0
    for index in range(count):
        value = 0.95 * value + white[index]
        out[index] = value
    return out


def _sorted_unique(t: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the times in order without duplicates, and their indices."""
    order = np.argsort(t, kind="stable")
    kept = np.append(True, np.diff(t[order]) > 1e-9)
    return t[order][kept], order[kept]


def _refined(t: FloatArray) -> FloatArray:
    """Return FINE times in each interval, the knots among them."""
    inner = t[:-1, None] + np.arange(FINE) / FINE * np.diff(t)[:, None]
    return np.append(inner.ravel(), t[-1])
