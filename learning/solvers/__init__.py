"""Solve the models that need all pairs, and schedule their solutions."""
