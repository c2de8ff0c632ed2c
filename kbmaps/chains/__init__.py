"""Rigid chains as products of exponentials and their learners."""
