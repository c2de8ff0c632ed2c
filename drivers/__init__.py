"""Drivers that read joint encoders: recordings, servo chains, serial encoders and ROS 2."""
