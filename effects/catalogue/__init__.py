"""The effects: one file each, with one class, found by `registry`.

The sentences and plots of a report are in `diagnosis/report/presenters`; docs/extending.md has an example.
"""
