"""Replay of a recording through sampler and learner as live, with errors measured on held-out rows."""
