"""Tensor trains: maps of many joints with few numbers per joint, and their learner."""
