"""A recording goes through sampler and learner as live, and what was learnt is judged on rows that were left out."""

from __future__ import annotations
