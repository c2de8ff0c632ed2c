"""A ROS 2 robot over rmw_zenoh, without ROS: the driver, and below `bench` a robot at the bytes."""

from __future__ import annotations
