"""The learner process: pairs in, predictions out.

`feed` gives each pair to `learning/online_learner.py`; `answers` serves `predict` and the other queries; `learner` has
one robot, and `host` the process.
"""
