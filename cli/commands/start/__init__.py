"""The first commands on a new robot."""
