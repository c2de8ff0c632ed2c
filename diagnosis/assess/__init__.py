"""Assess causes against alternatives, and the residual structure that they leave."""
