"""Commands of a running robot."""
