"""Rigid chains as products of exponentials, their learners, and a tool layer for any model."""
