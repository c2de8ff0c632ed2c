"""The one place that chooses hardware or simulation."""
