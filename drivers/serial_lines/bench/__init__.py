"""A board of encoders at the bytes, below any driver: for tests, and to try a configuration without an arm."""

from __future__ import annotations
