"""Planning of further measurements: the remaining uncertainty, the gain of more pairs, and the best next poses."""
