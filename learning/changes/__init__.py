"""Detect changes of tool, camera and joint offsets, and adapt to them."""
