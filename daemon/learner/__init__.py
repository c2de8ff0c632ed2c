"""The learner process: pairs in, predictions out."""
