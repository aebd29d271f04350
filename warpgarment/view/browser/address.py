"""Where a page is served: a port that can be had, and the host as this machine names it."""

from __future__ import annotations

import socket

from warpgarment.errors import UsageError

PORT, TRIED = 8080, 100  # the port that is tried first, and how many after it
_TAKEN = {98, 48, 10048, 10013}  # EADDRINUSE of Linux, macOS and Windows, and Windows' refusal


def free_port(host: str, port: int | None) -> int:
    """A port that can be had.

    Args:
        host: Address at which the page is served.
        port: The port; None for `PORT`, or the next one that is free; 0 for any free one.

    Raises:
        UsageError: There is none, or no such host.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    tried = range(PORT, PORT + TRIED) if port is None else [port]
    for number in tried:
        if not 0 <= number < 65536:
            raise UsageError(f"port {number}: it must be between 0 and 65535.")
        try:
            with socket.create_server((host, number), family=family) as found:
                return int(found.getsockname()[1])
        except OSError as error:
            if not isinstance(error, PermissionError) and error.errno not in _TAKEN:
                raise UsageError(f"the page cannot be served at {host!r}: {error.strerror or error}.") from None
    listed = f"ports {tried[0]} to {tried[-1]} are" if len(tried) > 1 else f"port {port} is"
    raise UsageError(f"{listed} taken, or not allowed. Choose another one, or 0 for any that is free.")


def reached(host: str) -> str:
    """The host in a URL that this machine can open."""
    if host in ("0.0.0.0", "::", ""):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host
