"""Tensor trains: maps of many joints in a few numbers each, and what learns them."""
