"""Plausibility check of a recording against its robot: columns, frames, units and joint offsets."""
