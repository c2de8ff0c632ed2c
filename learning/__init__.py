"""Online learner of pairs, without I/O and without a clock."""
