"""Two cameras' lenses and their places against each other, from images of a board."""
