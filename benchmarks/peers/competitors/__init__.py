"""The competitors, one module a method."""
