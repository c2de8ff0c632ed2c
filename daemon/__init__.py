"""Sampler and learner: the two processes, their zenoh interface, and the check of robot.toml as a whole (`config`)."""
