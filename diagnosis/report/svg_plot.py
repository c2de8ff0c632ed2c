"""Draw plots as inline SVG that follow the page's light or dark colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from bodyschema.interfaces.records import FloatArray


class Layout:
    """Layout of the report's drawings; no figure depends on it."""

    width, height = 380, 236
    left, top, right, bottom = 52, 10, 370, 196  # the axes
    steps, ticks = (1.0, 2.0, 2.5, 5.0, 10.0), 5  # between ticks, and usual number of them
    min_explained_share = 0.02  # share of the error variance that a plot must explain to be shown at first
    cut = 0.01  # share of single errors at each end that does not set the range of a plot
    cells, min_in_a_cell = (10, 6), 3
    # Histogram: columns, the quantile of the errors at which it ends, and noise samples per row.
    max_columns, min_columns, pairs_a_column, shown, drawn = 48, 12, 12, 0.99, 20
    side, margin = 300, 26  # of a view with arrows
    long, shorter = 0.1, 0.9  # arrow length as a share of the largest span, for the given quantile of the errors before


ASPECT = (Layout.right - Layout.left) / (Layout.bottom - Layout.top)


@dataclass(frozen=True)
class Plot:
    """Axes: x is linear, y is linear or logarithmic."""

    # x_label, y_label: with units
    x_label: str
    y_label: str
    # x, y: their ranges; from high to low where the axis runs the other way
    x: tuple[float, float]
    y: tuple[float, float]
    names: Sequence[str] = ()  # labels for whole numbers on the x axis, instead of figures
    log_y: bool = False  # True for a logarithmic y axis; its range is positive

    def svg(self, *marks: str) -> str:
        """Return the plot with marks, the first at the back."""
        label = escape(f"{self.y_label} against {self.x_label}", quote=True)
        box = (Layout.left, Layout.top, Layout.right - Layout.left, Layout.bottom - Layout.top)
        place = " ".join(f'{name}="{value}"' for name, value in zip(("x", "y", "width", "height"), box, strict=True))
        inside = f'<svg {place} viewBox="{" ".join(map(str, box))}">{"".join(marks)}</svg>'
        size = f"0 0 {Layout.width} {Layout.height}"
        return f'<svg viewBox="{size}" role="img" aria-label="{label}">{self._grid()}{inside}</svg>'

    def dots(self, x: FloatArray, y: FloatArray, look: str) -> str:
        """Draw the points inside the axes, as one path to keep the file small."""
        return f'<path class="dots {look}" d="{self._points(x, y)}"/>'

    def line(self, x: FloatArray, y: FloatArray, look: str) -> str:
        """Draw a curve through points in their order."""
        left, top = self._at(x, y)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(left, top, strict=True))
        return f'<polyline class="line {look}" points="{points}"/>'

    def bars(self, x: FloatArray, y: FloatArray, half: FloatArray, look: str) -> str:
        left, top = self._at(x, y)
        _, upper = self._at(x, y + half)
        _, lower = self._at(x, y - half)
        ends = zip(left, upper, lower, strict=True)
        path = "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in ends)
        inside = self._inside(x, y)
        middle = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(left[inside], top[inside], strict=True))
        return f'<path class="bars {look}" d="{path}"/><path class="means {look}" d="{middle}"/>'

    def area(self, x: FloatArray, y: FloatArray, look: str) -> str:
        left, top = self._at(x, y)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(left, top, strict=True))
        bottom = Layout.bottom
        return f'<polygon class="area {look}" points="{left[0]:.1f},{bottom} {points} {left[-1]:.1f},{bottom}"/>'

    def arrows(self, x: FloatArray, y: FloatArray, dx: FloatArray, dy: FloatArray, look: str) -> str:
        left, top = self._at(x, y)
        right, end = self._at(x + dx, y + dy)
        path = "".join(
            f"M{a:.1f} {b:.1f}l{c - a:.1f} {d - b:.1f}" for a, b, c, d in zip(left, top, right, end, strict=True)
        )
        return f'<path class="arrows {look}" d="{path}"/><path class="feet {look}" d="{self._points(x, y)}"/>'

    def moment(self, x: float, text: str) -> str:
        (left, _), top = self._at(np.array([x]), np.array([self.y[0]])), Layout.top
        side = "end" if x > 0.5 * sum(self.x) else "start"
        shift = -4 if side == "end" else 4
        return (
            f'<line class="moment" x1="{left[0]:.1f}" x2="{left[0]:.1f}" y1="{top}" y2="{Layout.bottom}"/>'
            f'<text class="named" x="{left[0] + shift:.1f}" y="{top + 11}" text-anchor="{side}">{escape(text)}</text>'
        )

    def _points(self, x: FloatArray, y: FloatArray) -> str:
        inside = self._inside(x, y)
        left, top = self._at(x[inside], y[inside])
        return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(left, top, strict=True))

    def _inside(self, x: FloatArray, y: FloatArray) -> np.ndarray:
        (left, right), (low, high) = sorted(self.x), sorted(self.y)
        return (x >= left) & (x <= right) & (y >= low) & (y <= high)

    def _at(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        low, high = self._height(self.y[0]), self._height(self.y[1])
        up = (self._height(y) - low) / (high - low)
        left, bottom = Layout.left, Layout.bottom
        return left + across * (Layout.right - left), bottom - up * (bottom - Layout.top)

    def _height(self, y: Any) -> Any:
        return np.log10(y) if self.log_y else y

    def _grid(self) -> str:
        left, right, bottom, parts = Layout.left, Layout.right, Layout.bottom, []
        for value in (log_ticks if self.log_y else ticks)(*sorted(self.y)):
            y = self._at(np.array([self.x[0]]), np.array([value]))[1][0]
            zero = " zero" if value == 0.0 else ""
            parts.append(f'<line class="grid{zero}" x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
            parts.append(f'<text x="{left - 5}" y="{y + 4:.1f}" text-anchor="end">{_figure(value)}</text>')
        marks = [(float(k), name) for k, name in enumerate(self.names)]
        for value, name in marks or [(value, _figure(value)) for value in ticks(*self.x)]:
            x = self._at(np.array([value]), np.array([self.y[0]]))[0][0]
            parts.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{escape(name)}</text>')
        middle = 0.5 * (left + right)
        below = Layout.height - 6
        parts.append(f'<text class="label" x="{middle}" y="{below}" text-anchor="middle">{escape(self.x_label)}</text>')
        turned = f"translate(11 {0.5 * (bottom + Layout.top):.0f}) rotate(-90)"
        parts.append(f'<text class="label" transform="{turned}" text-anchor="middle">{escape(self.y_label)}</text>')
        return "".join(parts)


def ticks(low: float, high: float) -> list[float]:
    step = round_up((high - low) / Layout.ticks)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [k * step for k in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Return the figures 1, 2 and 5 times a power of ten in a positive range."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [
        value
        for power in powers
        for value in (10.0**power, 2.0 * 10.0**power, 5.0 * 10.0**power)
        if low <= value <= high
    ]


def round_up(value: float) -> float:
    """Return the next figure of 1, 2, 2.5, 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-12)))
    return next(factor * power for factor in Layout.steps if factor * power >= value * (1.0 - 1e-9))


def span(*values: FloatArray, cut: float = 0.0, around_zero: bool = False) -> tuple[float, float]:
    """Return a range for values, with a margin.

    Args:
        cut: share of the values to leave out at each end.
        around_zero: True for a range symmetric about zero.
    """
    together = np.concatenate([np.ravel(v) for v in values])
    low, high = (float(v) for v in np.quantile(together, [cut, 1.0 - cut]))
    if around_zero:
        high = max(abs(low), abs(high))
        low = -high
    margin = 0.06 * (high - low) or max(abs(high), 1e-6)
    return low - margin, high + margin


def _figure(value: float) -> str:
    return f"{value + 0.0:,.10g}" if abs(value) < 1e5 else f"{value:.3g}"
