"""Find and measure AprilTags.

`finder` finds rough corners, and `image` refines them: `edge` measures the four edges, `bleed` corrects them for white
that bleeds into black, and the corners are their intersections. `tracker` computes a pose from the corners.
"""
