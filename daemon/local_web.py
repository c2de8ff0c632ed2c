"""What both HTTP servers share: requests name this machine, and no page from elsewhere reads or frames the answers.

A web page from elsewhere can make a browser ask a server on loopback. It cannot choose the header Host, and a name that
leads here by DNS rebinding shows there.
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
# Any port: a tunnel ends at one of its own.
_HERE = re.compile(r"(localhost|127\.0\.0\.1|\[::1\])(:[0-9]{1,5})?", re.IGNORECASE)


def host_refusal(hosts: Iterable[str]) -> str | None:
    """Return what is wrong with the headers Host of a request, for a person; None when nothing is."""
    found = list(hosts)
    if len(found) == 1 and _HERE.fullmatch(found[0]):
        return None
    asked = f"asks for {found[0][:100]!r}" if len(found) == 1 else f"has {len(found)} headers Host"
    return f"this address is for this machine alone, and the request {asked}: use 127.0.0.1 or localhost (docs/view.md)"
