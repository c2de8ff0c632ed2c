"""The one place that selects hardware, a recording or the simulation."""
