"""Model discrepancies that no effect names."""
