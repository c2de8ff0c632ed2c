"""From measured data and the robot's simulation to causes with names."""
