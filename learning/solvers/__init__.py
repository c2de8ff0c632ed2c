"""Models that need all pairs: solve them, and schedule that."""
