"""Drivers that read joint encoders: recordings, servo chains, serial encoders and ROS 2."""

from __future__ import annotations
