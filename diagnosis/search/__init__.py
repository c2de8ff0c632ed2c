"""Search for the sets of causes that explain the observations."""
