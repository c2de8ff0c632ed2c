"""Many robots at once: their processes, a comparison of their models, and the diagnosis of all their recordings."""
