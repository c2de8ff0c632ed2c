"""Extensions of bodyschema by one laboratory: a driver, a tracker and an effect."""
