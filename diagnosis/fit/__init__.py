"""Fit a simulation with tolerances to observations."""
