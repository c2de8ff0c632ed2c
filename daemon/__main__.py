"""`python -m daemon` is `bodyschema`."""

from __future__ import annotations

from daemon.cli import main

main()
