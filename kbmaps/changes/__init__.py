"""Noticing that an arm, its tool or its camera changed, and telling which."""
