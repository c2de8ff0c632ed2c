"""Learning curve, thinned out as it grows."""

from __future__ import annotations

from bodyschema.daemon.transport.status import CurvePoint

LARGEST = 400


class Curve:
    """Points of the learning curve, at most `LARGEST`, evenly spread over the pairs."""

    def __init__(self, points: list[CurvePoint] | None = None, stride: int = 1) -> None:
        self._points = list(points or [])
        self.stride = stride

    @property
    def points(self) -> list[CurvePoint]:
        """Copy of the curve so far."""
        return list(self._points)

    def add(self, pairs: int, error_m: float) -> None:
        """Add the prequential error after this many pairs, unless the thinning skips it."""
        if pairs % self.stride:
            return
        self._points.append(CurvePoint(pairs, error_m))
        if len(self._points) > LARGEST:
            self.stride *= 2
            self._points = [point for point in self._points if point.pairs % self.stride == 0]
