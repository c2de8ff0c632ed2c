"""See `drivers.bench.pty_shell`."""

from __future__ import annotations

from drivers.bench.pty_shell import PtyShell

__all__ = ["PtyShell"]
