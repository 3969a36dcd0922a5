"""Prefect's server behind a guard: a password, one host name, one origin, private files.

A page in a browser can send requests to this machine's ports, also to those of loopback, and
Prefect answers any page. So the server answers no request without the password (except for the page
that asks for it, and the health check), and none at all that

- names a host that is not this server: a page of evil.example may let its own name point to
  127.0.0.1 and is then, for the browser, of the same origin (DNS rebinding). An address cannot be
  redirected, so that addresses are admitted;
- comes from a page of another origin, by fetch, form or websocket.

Other pages cannot show the server's pages in a frame either, which prevents clickjacking. CSRF
tokens (PREFECT_SERVER_CSRF_PROTECTION_ENABLED) would add nothing: no browser sends this password by
itself, since it is not a cookie.
"""

import argparse
import asyncio
import contextlib
import ipaddress
import os
import sys
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from pipeline.flows.prefect_server import PASSWORD, quiet_prefect
from pipeline.isolation import die_with_parent
from storage.cache import private_folder
from storage.errors import TrilightError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

NAMES = "TRILIGHT_HOST_NAMES"
"""Variable with further host names of the server beside localhost, separated by commas."""
REQUEST_S = 15.0
"""Seconds in which the head of a request must arrive."""
_UNFRAMED = (b"content-security-policy", b"frame-ancestors 'none'")


def guard_requests(inner: "ASGIApp", names: Collection[str]) -> "ASGIApp":
    """Return an ASGI application that passes on allowed requests, and refuses all others.

    Args:
        names: host names of this server, beside localhost and addresses.
    """
    ours = {"localhost", *(name.lower() for name in names)}

    async def serve_allowed(scope: "Scope", receive: "Receive", send: "Send") -> None:
        from starlette.responses import PlainTextResponse
        from starlette.websockets import WebSocketClose

        async def send_unframed(message: "Message") -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), _UNFRAMED]
            await send(message)

        application = inner
        if scope["type"] != "lifespan" and (refusal := _refusal(scope["headers"], ours)):
            is_websocket = scope["type"] == "websocket"
            application = (
                WebSocketClose(1008, refusal) if is_websocket else PlainTextResponse(refusal, 403)
            )
        await application(scope, receive, send_unframed)

    return serve_allowed


def _refusal(headers: Collection[tuple[bytes, bytes]], ours: Collection[str]) -> str | None:
    """Return why a request is refused, or None."""
    hosts, origins = (
        [value.decode("latin-1").lower() for name, value in headers if name == header]
        for header in (b"host", b"origin")
    )
    if len(hosts) != 1 or not _is_ours(hosts[0], ours):
        return f"this is no name of this server; set {NAMES} where it has others"
    if any(origin.partition("://")[2] != hosts[0] for origin in origins):
        return "pages of other origins are not answered"
    return None


def _is_ours(host: str, ours: Collection[str]) -> bool:
    with contextlib.suppress(ValueError):
        name = urlsplit(f"//{host}").hostname or ""
        return name in ours or bool(ipaddress.ip_address(name))
    return False


def request_timeout_protocol() -> type[asyncio.Protocol]:
    """Return uvicorn's HTTP protocol with a time limit for requests, which it lacks.

    A connection is closed after REQUEST_S without a complete head of a request.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol  # limits the size of a head

    class ImpatientProtocol(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self._look(idle_since=object())

        def _look(self, idle_since: object) -> None:
            is_idle = self.cycle is None or self.cycle.response_complete
            if self.transport.is_closing() or self.transport.get_protocol() is not self:
                return  # ended, or a websocket by now
            if is_idle and self.cycle is idle_since:
                self.transport.close()
                return
            seen = self.cycle if is_idle else object()
            self.loop.call_later(REQUEST_S, self._look, seen)

    return ImpatientProtocol


def serve(host: str, port: int) -> None:
    """Serve Prefect at an address until this process gets a signal to end.

    All files that it writes are readable by its user only, the SQLite database included.

    Raises:
        TrilightError: there is no password.
    """
    if not os.environ.get(PASSWORD):
        raise TrilightError(f"{PASSWORD} is not set; expected USER:PASSWORD.")
    os.umask(0o077)
    names = [name for name in os.environ.get(NAMES, "").split(",") if name]
    quiet_prefect()
    home = private_folder(Path(os.environ["PREFECT_HOME"]))
    for database in home.glob("prefect.db*"):
        database.chmod(0o600)  # earlier versions wrote it readable for others
    defaults = {
        "PREFECT_UI_API_URL": "/api",  # relative: valid under each of the host names
        "PREFECT_UI_STATIC_DIRECTORY": str(
            home / "ui"
        ),  # not in the packages, which other users share
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{host}:{port}",
    }
    for variable, value in defaults.items():
        os.environ.setdefault(variable, value)
    import uvicorn
    from prefect.server.api.server import create_app
    from prefect.settings import get_current_settings

    settings = get_current_settings()
    uvicorn.run(
        guard_requests(create_app(final=True), names),
        http=request_timeout_protocol(),
        host=host,
        port=port,
        log_level=settings.server.logging_level.lower(),
        timeout_keep_alive=settings.server.api.keepalive_timeout,
        ws_ping_interval=settings.server.api.websocket_ping_interval,
        ws_ping_timeout=settings.server.api.websocket_ping_timeout,
    )


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(description="Prefect's server, behind a password.")
    parser.add_argument("--host", default="127.0.0.1", help="address to bind to")
    parser.add_argument("--port", type=int, default=4200, help="port to listen at")
    parser.add_argument("--with-parent", action="store_true", help="end when the parent does")
    options = parser.parse_args(arguments)
    if options.with_parent:
        die_with_parent()
    try:
        serve(options.host, options.port)
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")


if __name__ == "__main__":
    main(sys.argv[1:])
