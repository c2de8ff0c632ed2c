"""Rendered stereo images: what the cameras see, in a process of its own."""
