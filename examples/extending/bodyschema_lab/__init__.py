"""What one laboratory adds to bodyschema: a driver, a tracker and an effect."""
