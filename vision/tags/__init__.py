"""Find and measure AprilTags."""
