"""A robot as its files describe it: robot.toml and URDF.

`description` checks the tables [robot] and [camera]; `Config.load` in `daemon/config.py` checks robot.toml as a whole.
"""
