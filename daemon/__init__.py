"""Sampler and learner: the two processes, their store, their zenoh interface, and the command line."""
