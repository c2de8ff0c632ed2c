"""The one place that chooses hardware, a recording or the simulation."""
