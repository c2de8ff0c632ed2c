"""Many robots at once: who is there, how their models differ, and the diagnosis of all their recordings."""

from __future__ import annotations
