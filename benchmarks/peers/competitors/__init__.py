"""The competitors, one module for each method."""
