"""Change the settings of servos, assign them to joints, and undo it."""
