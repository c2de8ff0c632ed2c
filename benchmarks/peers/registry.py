"""All competitors, in the order of the page. To add one, write a module with a `Competitor` and list it here."""

from __future__ import annotations

from benchmarks.peers.competitors import (
    adaptive_filters,
    calibration,
    chains,
    gaussian_process,
    gradient_schema,
    lwpr,
    maps,
    mixed,
    neural_net,
    psom,
    virtual_robots,
)
from benchmarks.peers.problem import Competitor

COMPETITORS: tuple[Competitor, ...] = (
    *chains.COMPETITORS,
    *mixed.COMPETITORS,
    *maps.COMPETITORS,
    *calibration.COMPETITORS,
    gradient_schema.COMPETITOR,
    *virtual_robots.COMPETITORS,
    gaussian_process.COMPETITOR,
    neural_net.COMPETITOR,
    lwpr.COMPETITOR,
    *psom.COMPETITORS,
    *adaptive_filters.COMPETITORS,
)
BY_KEY: dict[str, Competitor] = {competitor.key: competitor for competitor in COMPETITORS}
