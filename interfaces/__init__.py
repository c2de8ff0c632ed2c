"""Protocols and frozen records shared by all other packages."""

from __future__ import annotations
