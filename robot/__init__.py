"""A robot as its files describe it: robot.toml and URDF."""
