"""Access to the screen's page: requests to this machine's loopback name with the token.

Other users of this machine can reach a loopback port too, and a foreign page in the operator's
browser can send requests to it. The token is in the query of every address, not in a cookie:
cookies are shared by all ports of a host, so that another user's server would receive it.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from typing import Final
from urllib.parse import urlsplit

LOOPBACK: Final = "127.0.0.1"
NAMES: Final = frozenset({LOOPBACK, "localhost", "::1"})


def new_token() -> str:
    """Return a token of 256 random bits for an address."""
    return secrets.token_urlsafe(32)


def refusal(
    hosts: Sequence[str], origins: Sequence[str], tokens: Sequence[str], token: str
) -> str | None:
    """Return in one line why a request is refused, None if it is accepted.

    hosts, origins, tokens: the values of its headers `Host` and `Origin` and of its query, for
    every occurrence. The port of `Host` may differ (a forwarded one); the name must be a loopback
    name, because a foreign name that resolves to loopback is a foreign page (DNS rebinding).
    """
    host = hosts[0] if len(hosts) == 1 else ""
    if host_name(host) not in NAMES:
        return f"the address names the host {host!r}, expected {LOOPBACK} or localhost"
    if any(origin != f"http://{host}" for origin in origins):
        return f"it comes from a page of {origins[0]!r}, expected http://{host}"
    sent = [text.encode(errors="surrogateescape") for text in tokens]  # any bytes may arrive
    if len(sent) != 1 or not secrets.compare_digest(sent[0], token.encode()):
        return "the address holds no valid token; open the one that `bramah monitor --web` printed"
    return None


def host_name(host: str) -> str:
    """Return the name in a `Host` header without its port, '' for an invalid header."""
    try:
        parts = urlsplit(f"//{host}")
        whole = parts.netloc == host and "@" not in host and (parts.port or 0) >= 0
    except ValueError:
        return ""
    return parts.hostname or "" if whole else ""
