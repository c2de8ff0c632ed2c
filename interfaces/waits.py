"""Waits that many loops share: for a source, a process, an answer, or the next attempt."""

READ_S = 0.2  # one read of a source: a loop notices a stop within this time
POLL_S = 0.1  # between two looks at a process, a port or a screen
STATUS_EVERY_S = 1.0  # a process publishes its status, and views ask for it
LINE_EVERY_S = 2.0  # between two lines of progress
RETRY_S = 1.0  # after a failure within a process
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0  # before an attempt; doubled after each failure
SILENT_AFTER_S = 2.0  # a source without data for this long is reported
RIVAL_AFTER_S = 1.0  # after this silence of a sender, another one is accepted
ANSWER_LIMIT_S = 2.0  # for the answer of another process
END_LIMIT_S = 5.0  # for the end of a child process
NICENESS = 10  # of work that must not delay sampler and learner
