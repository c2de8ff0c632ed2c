"""Feetech servos of the STS, SMS and SCS series: the driver, and below `bench` a chain of them at the bytes."""

from __future__ import annotations
