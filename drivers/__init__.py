"""Joint encoders in: recordings now, servo chains and serial encoders beside them."""

from __future__ import annotations
