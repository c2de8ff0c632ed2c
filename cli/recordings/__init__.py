"""Get recordings: from the running robot, from other programs, from the simulation."""
