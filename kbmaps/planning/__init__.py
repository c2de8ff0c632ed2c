"""What the pairs leave open, what more of them would gain, and where to measure next."""
