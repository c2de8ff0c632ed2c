"""Check that the marker has one position on the hand: of several reflectors or tags, rows may be of different ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from bodyschema.interfaces.records import FloatArray

from .search import Poses, ReadingSearch
from .verdict import Plausibility, mm


class _Settings:
    # Rows that place the arm, and how often they are chosen: of three markers in equal parts, none are of one alone
    # once in 140.
    chosen: int = 5
    tries: int = 400
    one_place_m: float = 0.01  # Places that are nearer are one: a marker that is loose moves less [m]
    # Smallest share of the rows and number of poses at a place, and smallest share of the rows at all places together.
    share: float = 0.08
    fewest: int = 3
    covered: float = 0.85
    # Several places are reported if the pairs fit this many times better. Three reflectors on a real arm fitted 28
    # times better; 13 real recordings of one marker had no second place, whatever the factor.
    better: float = 5.0
    seed: int = 0


def several_markers(search: ReadingSearch, before: float) -> Plausibility | None:
    """Return a refusal if the marker is at several places on the hand in turn, otherwise None.

    The arm is placed by a few rows at a time (Fischler and Bolles 1981): if these are of one marker, the others lie
    at few places on the hand.
    """
    rng, rows = np.random.default_rng(_Settings.seed), len(search.q)
    if rows < 2 * _Settings.chosen:
        return None
    chosen = rng.permuted(np.tile(np.arange(rows), (_Settings.tries, 1)), axis=1)[:, : _Settings.chosen]
    found = search.place_rows(chosen)
    scatters = [_scatter(search.offsets_on_hand(found, k)) for k in range(_Settings.tries)]
    places = _places(search, search.offsets_on_hand(found, int(np.argmin(scatters))))
    counts = np.bincount(places[places >= 0], minlength=1)
    largest = np.flatnonzero(places == counts.argmax())
    if len(largest) < _Settings.chosen:
        return None
    offsets_on_hand = search.offsets_on_hand(search.place_rows(largest[None]), 0)
    places = _places(search, offsets_on_hand)
    names = np.unique(places[places >= 0])
    if len(names) < 2 or (places >= 0).mean() < _Settings.covered:
        return None
    centres = np.stack([offsets_on_hand[places == name].mean(axis=0) for name in names])
    kept = places >= 0
    off = offsets_on_hand[kept] - centres[np.searchsorted(names, places[kept])]
    after = max(float(np.sqrt(np.square(off).sum(axis=1).mean())), search.exact_m)
    # A marker that was moved once is reported by calibration, with its row.
    changes = int((np.diff(places[kept]) != 0).sum())
    if before < _Settings.better * after or changes < len(names):
        return None
    shares = ", ".join(f"{100.0 * float((places == name).mean()):.0f} %" for name in names)
    apart = max(float(np.linalg.norm(one - other)) for one in centres for other in centres)
    return Plausibility(
        f"it seems that the marker is at {len(names)} places on the hand in turn, up to {mm(apart)} apart ({shares} of "
        f"the rows): at its own place, each row fits to {mm(after)}, and as they are to {mm(before)}",
        "Give the rows of one marker at a time, where several reflectors or tags were measured. Where it is one, it is "
        "loose, or its rows are of several tools",
        misread=True,
        better=before / after,
    )


def _scatter(offsets_on_hand: FloatArray) -> float:
    """Return the median distance of points (n, 3) from the nearest but one [m]."""
    apart = np.linalg.norm(offsets_on_hand[:, None] - offsets_on_hand, axis=2)
    return float(np.median(np.partition(apart, 2, axis=1)[:, 2]))


def _places(search: ReadingSearch, offsets_on_hand: FloatArray) -> NDArray[np.intp]:
    """Return the place of each point (n,), from 1; -1 for a point without enough others at its place."""
    places = np.asarray(fcluster(linkage(offsets_on_hand), _Settings.one_place_m, "distance"), dtype=np.intp)
    for place in range(1, int(places.max()) + 1):
        rows = np.flatnonzero(places == place)
        # Repeated or held poses have the same errors of the arm in each row.
        if (
            len(rows) < _Settings.share * len(places)
            or len(Poses.of(search.chain, search.q[rows]).rows) < _Settings.fewest
        ):
            places[rows] = -1
    return places
