"""Find the named causes of the difference between measured data and the robot's simulation."""
