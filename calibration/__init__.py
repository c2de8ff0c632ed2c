"""Mathematics on recordings: calibration, latency, comparison, plausibility."""
