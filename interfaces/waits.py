"""Waits that many loops share: for a source, a process, an answer, or the next attempt."""


class Waits:
    read_s = 0.2  # one read of a source: a loop notices a stop within this time
    poll_s = 0.1  # between two looks at a process, a port or a screen
    status_every_s = 1.0  # a process publishes its status, and views ask for it
    line_every_s = 2.0  # between two lines of progress
    retry_s = 1.0  # after a failure within a process
    first_s, longest_s = 0.5, 30.0  # before an attempt; doubled after each failure
    silent_after_s = 2.0  # a source without data for this long is reported
    rival_after_s = 1.0  # after this silence of a sender, another one is accepted
    answer_limit_s = 2.0  # for the answer of another process
    end_limit_s = 5.0  # for the end of a child process


NICENESS = 10  # of work that must not delay sampler and learner
