"""The effects: one file each, with one class, found by `registry`."""
