"""Commands for servos and cameras."""
