"""Driver for Feetech servos of the STS, SMS and SCS series, with an emulator."""
