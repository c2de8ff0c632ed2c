"""Online learner of pairs, without I/O and without a clock.

`online_learner` receives a pair, `regime` teaches it to all models, and `snapshot` answers queries.
"""
