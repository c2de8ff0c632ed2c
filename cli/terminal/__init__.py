"""Terminal views, and what several commands share."""
