"""Signals, logs, watchdog and supervision of a process."""
