"""The check that a recording can be of this robot: its columns, frames, units and zeros."""
