"""Set thread names for the system's tools."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path


def show_name() -> None:
    """Show the beginning of this thread's Python name in `top -H` and `ps -L`, where the system supports it."""
    with contextlib.suppress(OSError):
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(threading.current_thread().name[:15])
