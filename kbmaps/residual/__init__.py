"""A rigid chain and what it does not explain: a smooth remainder learnt with it."""
