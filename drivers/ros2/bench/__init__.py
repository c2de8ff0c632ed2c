"""A ROS 2 robot at the bytes: what rmw_zenoh would put on the wire, with faults on demand.

In virtual time behind a `Link`, or over zenoh with this process as the robot's router.
"""

from __future__ import annotations
