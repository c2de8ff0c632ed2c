"""Rigid chain with a smooth remainder that is learnt with it."""
