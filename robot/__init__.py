"""A robot as its files describe it: robot.toml and URDF.

`description` checks the tables [robot] and [camera]; `bodyschema.daemon.config.Config.load` checks robot.toml as a whole.
"""
