"""The Protocols and frozen records that all other packages speak."""

from __future__ import annotations
