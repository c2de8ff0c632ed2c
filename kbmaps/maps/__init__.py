"""Kinematic Bézier Maps and their direct learners: incremental (NLMS) and exact least squares."""
