"""Find a ball of known colour in images, and measure it."""
