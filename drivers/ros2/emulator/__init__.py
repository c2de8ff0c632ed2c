"""Emulator of a ROS 2 robot at the byte level: the messages of rmw_zenoh, with fault injection.

It runs in virtual time behind a `Link`, or over zenoh with this process as the robot's router.
"""
