"""Driver for ROS 2 robots over rmw_zenoh, without a ROS installation, with an emulator."""
