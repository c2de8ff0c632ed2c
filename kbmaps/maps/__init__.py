"""Kinematic Bézier Maps and what learns them directly: the instant and the exact learner."""
