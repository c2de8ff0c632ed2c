"""The demo: a scene in simulation, the two real processes, one that asks, one that judges, and a view of it all."""

from __future__ import annotations
