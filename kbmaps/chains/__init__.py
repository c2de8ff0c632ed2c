"""Rigid chains as products of exponentials, what learns them, and a tool at the end of any model."""
