"""The sampler process: joint readings and camera frames in, pairs out."""
