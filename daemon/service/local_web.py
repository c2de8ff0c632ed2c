"""Checks that both HTTP servers share: requests must name this machine; other sites cannot read or frame the answers.

A web page from elsewhere can make a browser send requests to a server on loopback. It cannot choose the Host header, so
a name that resolves here by DNS rebinding is detected.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

LOOPBACK = "127.0.0.1"
HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
# Any port, because a tunnel may end at another one.
_HERE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)


def host_refusal(hosts: Iterable[str]) -> str | None:
    """Return the fault of a request's Host headers, as a message, or None."""
    found = list(hosts)
    if len(found) == 1 and _HERE.fullmatch(found[0]):
        return None
    asked = f"asks for {found[0][:100]!r}" if len(found) == 1 else f"has {len(found)} headers Host"
    return f"this address is for this machine alone, and the request {asked}: use 127.0.0.1 or localhost (docs/view.md)"
