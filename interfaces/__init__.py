"""Protocols and frozen records shared by all other packages."""
