"""Marker positions that other programs send: UDP datagrams, OptiTrack, zenoh keys and ROS 2 topics."""
