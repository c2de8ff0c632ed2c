"""Commands for recordings and many robots."""
