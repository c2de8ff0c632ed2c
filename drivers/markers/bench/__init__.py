"""Emulated senders of marker positions: the bytes that real ones put on the wire."""

from __future__ import annotations
