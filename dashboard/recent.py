"""Newest pairs of the sampler: their segments, and the model's residuals at them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

import numpy as np

from bodyschema.daemon.transport.wire import PredictReply
from bodyschema.interfaces.errors import RequestError
from bodyschema.interfaces.records import Pair

from .documents import CloudDocument, Segment


class RecentSettings:
    kept: int = 3000  # pairs
    largest_cloud: int = 800  # pairs
    shown_segments: int = 40  # the newest
    decimals: int = 6  # of a coordinate [m] that is sent to the page: a micrometre


NOTHING = CloudDocument("", [], [], [], None, None)


class RecentPairs:
    """At most `kept` pairs of one store, in order."""

    def __init__(self) -> None:
        self._pairs: deque[Pair] = deque(maxlen=RecentSettings.kept)

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def newest(self) -> Pair | None:
        return self._pairs[-1] if self._pairs else None

    def upto(self, seq: int, count: int) -> list[Pair]:
        """Return the pair with this sequence number and those before it, at most `count`; [] if it is missing."""
        at = next((k for k in range(len(self._pairs) - 1, -1, -1) if self._pairs[k].seq == seq), -1)
        return [self._pairs[k] for k in range(max(at + 1 - count, 0), at + 1)]

    def add(self, pairs: Iterable[Pair]) -> None:
        self._pairs.extend(pairs)

    def segments(self) -> list[Segment]:
        """Return the newest segments, the newest last."""
        runs: list[list[Pair]] = []
        for pair in self._pairs:
            if runs and runs[-1][0].segment == pair.segment:
                runs[-1].append(pair)
            else:
                runs.append([pair])
        begins = self._pairs[0].seq if self._pairs else 1
        return [
            Segment(
                segment=run[0].segment,
                pairs=len(run),
                utc=run[0].utc,
                lasted_s=max(run[-1].t - run[0].t, 0.0),
                complete=begins == 1 or run[0].seq > begins,
            )
            for run in runs[-RecentSettings.shown_segments :]
        ]

    def chosen(self, after_seq: int, upto_seq: int) -> list[Pair]:
        """Return at most `largest_cloud` pairs after one sequence number and up to another, evenly spread."""
        wanted = [pair for pair in self._pairs if after_seq < pair.seq <= upto_seq]
        if len(wanted) <= RecentSettings.largest_cloud:
            return wanted
        return [wanted[k] for k in np.linspace(0, len(wanted) - 1, RecentSettings.largest_cloud).round().astype(int)]


def cloud(pairs: list[Pair], predict: Callable[[list[list[float]]], PredictReply]) -> CloudDocument:
    """Return the model's residuals at pairs.

    Args:
        predict: queries the learner; raises RequestError while it has no model.

    Raises:
        BusError: the learner does not answer.
    """
    if not pairs:
        return NOTHING
    try:
        reply = predict([pair.q.tolist() for pair in pairs])
    except RequestError:
        return NOTHING
    x = np.array([pair.x for pair in pairs])
    residual = x - np.array(reply.x)
    lengths = np.linalg.norm(residual, axis=1)
    return CloudDocument(
        model=reply.model,
        x=x.round(RecentSettings.decimals).tolist(),
        residual=residual.round(RecentSettings.decimals).tolist(),
        segment=[pair.segment for pair in pairs],
        median_m=float(np.median(lengths)),
        p95_m=float(np.quantile(lengths, 0.95)),
    )
