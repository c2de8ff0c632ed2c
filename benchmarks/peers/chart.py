"""Double-logarithmic line charts as inline SVG that follows the page's light or dark colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

WIDTH, HEIGHT = 520, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 54, 14, 12, 40
# Room for names at the lines' ends, and between two of them.
_FOR_NAMES, _NAME_HEIGHT = 190, 14
_MANTISSAS = (1, 2, 5)
_NARROW_DECADES = 1.6


@dataclass(frozen=True)
class Style:
    """Appearance of a line: its colour, dashes and weight."""

    colour: str
    dashes: str = ""
    width: float = 2.4


@dataclass(frozen=True)
class Line:
    """A curve with the half-length of an error bar at each point (None: no bar)."""

    key: str
    title: str
    style: Style
    points: Sequence[tuple[float, float]]
    bars: Sequence[float | None] = ()


@dataclass(frozen=True)
class Chart:
    """Lines with their names at their ends, a floor below which nothing can be expected, and goals as points."""

    x_label: str
    y_label: str
    lines: Sequence[Line]
    floor: Sequence[tuple[float, float]] = ()
    goals: Sequence[tuple[float, float]] = ()
    laws: Sequence[Line] = field(default_factory=tuple)
    named: Sequence[str] = ()

    def svg(self) -> str:
        axes = _Axes.around(self)
        parts = [axes.grid(self.x_label, self.y_label)]
        if self.floor:
            parts.append(axes.floor(self.floor))
        parts += [axes.law(law) for law in self.laws]
        parts += [axes.line(line) for line in reversed(self.lines)]
        parts += [axes.goal(point) for point in self.goals]
        if self.named:
            parts.append(axes.names([line for line in self.lines if line.key in self.named]))
        width = WIDTH + (_FOR_NAMES if self.named else 0)
        label = escape(f"{self.y_label} against {self.x_label}", quote=True)
        return f'<svg viewBox="0 0 {width} {HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'


@dataclass(frozen=True)
class _Axes:
    """Both axes' limits, logarithms to base 10."""

    x: tuple[float, float]
    y: tuple[float, float]
    ticks_x: Sequence[float]

    @classmethod
    def around(cls, chart: Chart) -> _Axes:
        points = [point for line in chart.lines for point in line.points] + list(chart.goals) + list(chart.floor)
        xs, ys = sorted({x for x, _ in points}), [y for _, y in points]
        pad = 0.04 * math.log10(xs[-1] / xs[0]) if len(xs) > 1 else 0.2
        low, high = math.log10(min(ys)) - 0.08, math.log10(max(ys)) + 0.08
        return cls((math.log10(xs[0]) - pad, math.log10(xs[-1]) + pad), (low, high), xs)

    def at(self, x: float, y: float) -> tuple[float, float]:
        across = (math.log10(x) - self.x[0]) / (self.x[1] - self.x[0])
        up = (math.log10(y) - self.y[0]) / (self.y[1] - self.y[0])
        return _LEFT + across * (WIDTH - _LEFT - _RIGHT), HEIGHT - _BOTTOM - up * (HEIGHT - _TOP - _BOTTOM)

    def grid(self, x_label: str, y_label: str) -> str:
        bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
        parts = []
        for tick in self._ticks_y():
            _, y = self.at(self.ticks_x[0], tick)
            parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
        for tick in self.ticks_x:
            x, _ = self.at(tick, 10 ** self.y[0])
            parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}"/>')
            parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{_number(tick)}</text>')
        middle = 0.5 * (_LEFT + right)
        parts.append(f'<text class="name" x="{middle}" y="{HEIGHT - 4}" text-anchor="middle">{escape(x_label)}</text>')
        turned = f"translate(12 {0.5 * (bottom + _TOP):.0f}) rotate(-90)"
        parts.append(f'<text class="name" transform="{turned}" text-anchor="middle">{escape(y_label)}</text>')
        return "".join(parts)

    def line(self, line: Line) -> str:
        points = [self.at(*point) for point in line.points]
        style = f'stroke="{line.style.colour}" stroke-width="{line.style.width}"'
        dashes = f' stroke-dasharray="{line.style.dashes}"' if line.style.dashes else ""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        marks = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{1.3 * line.style.width:.1f}" fill="{line.style.colour}"/>'
            for x, y in points
        )
        for (n, error), bar in zip(line.points, line.bars, strict=False):
            if bar:
                (x, top), (_, bottom) = self.at(n, error + bar), self.at(n, max(error - bar, 0.2 * error))
                marks += f'<line {style} x1="{x:.1f}" x2="{x:.1f}" y1="{top:.1f}" y2="{bottom:.1f}"/>'
        title = f"<title>{escape(line.title)}</title>"
        return f'<g data-model="{line.key}">{title}<polyline fill="none" {style}{dashes} points="{path}"/>{marks}</g>'

    def names(self, lines: Sequence[Line]) -> str:
        """Return titles beside the last points, moved apart where they would overlap."""
        ends = sorted(((self.at(*line.points[-1]), line) for line in lines), key=lambda end: end[0][1])
        heights = apart([y for (_, y), _ in ends])
        parts = []
        for ((x, y), line), height in zip(ends, heights, strict=True):
            left = WIDTH - _RIGHT + 14
            path = (
                f'<path class="leader" stroke="{line.style.colour}" d="M{x + 4:.1f} {y:.1f}L{left - 3} {height:.1f}"/>'
            )
            text = f'<text class="end" fill="{line.style.colour}" x="{left}" y="{height + 4:.1f}">{escape(line.title)}'
            parts.append(f'<g data-model="{line.key}">{path}{text}</text></g>')
        return "".join(parts)

    def law(self, line: Line) -> str:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (self.at(*point) for point in line.points))
        style = f'stroke="{line.style.colour}" stroke-dasharray="2 4" stroke-width="1.5"'
        return f'<g data-model="{line.key}"><polyline fill="none" {style} points="{path}"/></g>'

    def floor(self, points: Sequence[tuple[float, float]]) -> str:
        upper = [self.at(*point) for point in points]
        bottom = HEIGHT - _BOTTOM
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in upper)
        area = f"{path} {upper[-1][0]:.1f},{bottom} {upper[0][0]:.1f},{bottom}"
        return f'<polygon class="floor" points="{area}"/><polyline class="bound" points="{path}"/>'

    def goal(self, point: tuple[float, float]) -> str:
        x, y = self.at(*point)
        return f'<path class="goal" d="M{x:.1f} {y - 7:.1f}l6 7l-6 7l-6 -7z"><title>goal</title></path>'

    def _ticks_y(self) -> list[float]:
        narrow = self.y[1] - self.y[0] < _NARROW_DECADES
        ticks = [
            mantissa * 10.0**power
            for power in range(math.floor(self.y[0]), math.ceil(self.y[1]) + 1)
            for mantissa in (_MANTISSAS if narrow else (1,))
        ]
        return [tick for tick in ticks if self.y[0] <= math.log10(tick) <= self.y[1]]


def apart(heights: Sequence[float]) -> list[float]:
    """Return ascending heights within the chart, at least a name's height apart."""
    placed: list[float] = []
    for height in heights:
        placed.append(max(height, placed[-1] + _NAME_HEIGHT) if placed else height)
    lowest = float(HEIGHT - _BOTTOM)
    for place in reversed(range(len(placed))):
        placed[place] = min(placed[place], lowest)
        lowest = placed[place] - _NAME_HEIGHT
    return placed


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1 else f"{value:.6f}".rstrip("0")
