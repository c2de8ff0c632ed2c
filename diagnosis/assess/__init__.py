"""Assess causes against alternatives, and what they leave unexplained."""
