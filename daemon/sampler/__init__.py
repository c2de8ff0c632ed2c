"""The sampler process: joint readings and camera frames in, pairs out.

`sampler` makes a pair: `align` interpolates the angles at the time of a frame, `gate` accepts the step, and
`recordings/store` keeps it. The learner receives it in `daemon/learner/feed.py`.
"""
