"""Unnamed causes: errors that no effect describes, found as families of smooth functions."""
