"""Terminal views, and parts that several commands share."""
