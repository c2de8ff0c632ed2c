"""Scan and watch the joints of an arm, and describe it."""
