"""Present each effect: one file each, with its sentences and its plot, found by `registry`."""
