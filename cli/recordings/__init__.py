"""Get recordings from the running robot, from other programs and from the simulation, and diagnose them."""
