"""Driver for Dynamixel servos, with an emulator."""
