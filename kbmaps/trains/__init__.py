"""Tensor trains: maps of many joints in few numbers per joint, and their learner."""
