"""HTTP server of a page on loopback: guards requests, and dispatches them by a table of routes.

The address holds a secret token, as the first component of every path. A browser sends the host
name of its request and the origin of the requesting page. Both must be those of this server, so
that DNS rebinding and a guessed port fail. Static files are listed when the server starts, so that
a request's path only selects from a list.
"""

import contextlib
import hmac
import json
import math
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote

from storage.errors import TrilightError

MOST_CONNECTIONS = 32
"""Maximum number of concurrent responses; a browser opens six connections, and others wait."""

_REQUEST_S = 15.0
"""Seconds within which a whole request must arrive before its connection is closed."""

_MOST_AWAITED = 64
"""Maximum number of connections without a whole request; one more closes the oldest."""

_STALLED_S = 30.0
"""Seconds without progress after which a connection is dropped."""

HOST = "127.0.0.1"
"""Address of the server, which only this machine reaches."""

_ONCE = ("host", "origin", "sec-fetch-site", "sec-fetch-dest", "content-length")
"""Headers that may stand only once, since another program might read the other one of two."""

MAX_PATH = 4096
"""Maximum number of characters of a path with its query."""

MAX_BODY_BYTES = 1 << 18
"""Maximum size of a request's body in bytes."""

SAFE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Headers of every response; none lets another origin read it."""

Refusal = tuple[HTTPStatus, str]
"""Status of a refused request, and the reason as a sentence that the page shows."""

STATIC = Path(__file__).with_name("static")
_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    "": "text/plain; charset=utf-8",
}


@dataclass(frozen=True, kw_only=True)
class Response:
    """Response to a request."""

    body: bytes
    kind: str = "application/json"
    """Media type of the body."""
    headers: Mapping[str, str] = field(default_factory=dict)
    """Headers in addition to SAFE_HEADERS."""


def json_response(value: Any) -> Response:
    """Return a response with a value as JSON."""
    return Response(body=json.dumps(value, allow_nan=False).encode())


@dataclass(frozen=True, kw_only=True)
class Request:
    """Request that passed the guard."""

    method: str = "GET"
    path: str
    """Decoded path below the token, without the first slash."""
    query: Mapping[str, str]
    """Parameters after the question mark, by name."""
    body: Any = None
    """JSON value of a POST; None for a GET."""


class NotFound(TrilightError):
    """Error of a path without a route or a resource (404)."""


Route = Callable[[Request], Response]
"""Handler of one path, or of all paths below a prefix that ends in a slash; raises TrilightError
with a sentence for the page, NotFound where there is no resource."""

Routes = Mapping[str, Route]
"""Routes by method and path, such as `GET api/scene`."""


def dispatch(routes: Routes, request: Request) -> Response:
    """Return the response of the route of a request; raises TrilightError as a `Route` does."""
    name = f"{request.method} {request.path}"
    for prefix, route in routes.items():
        if name == prefix or (prefix.endswith("/") and name.startswith(prefix)):
            return route(request)
    raise NotFound(f"{request.path or 'the page'}: nothing is there.")


class PageServer(ThreadingHTTPServer):
    """Server on loopback; `address` is the URL to open."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, routes: Routes, *, port: int = 0) -> None:
        """Listen on a port; 0 stands for any free one.

        Raises:
            TrilightError: the port cannot be used.
        """
        self.routes = routes
        self.token = secrets.token_urlsafe(24)
        self.slots = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self._awaited: dict[socket.socket, float] = {}
        self._changing = threading.Lock()
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise TrilightError(
                f"--port is {port}, which cannot be listened at ({error.strerror}); expected a "
                "free port, or none, and one is found."
            ) from error

    @property
    def address(self) -> str:
        """URL of the page, with the secret token."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def await_request(self, connection: socket.socket) -> None:
        """Record that a connection has no request yet; of too many, close the oldest."""
        with self._changing:
            self._awaited[connection] = time.monotonic()
            if len(self._awaited) > _MOST_AWAITED:
                self._end(next(iter(self._awaited)))

    def note_arrival(self, connection: socket.socket) -> None:
        """Record that a connection has a whole request, or has ended."""
        with self._changing:
            self._awaited.pop(connection, None)

    def service_actions(self) -> None:
        """Close connections whose request takes too long; the server calls this twice a second."""
        with self._changing:
            before = time.monotonic() - _REQUEST_S
            for connection in [key for key, began in self._awaited.items() if began < before]:
                self._end(connection)

    def _end(self, connection: socket.socket) -> None:
        """Shut a connection down, which wakes its reading thread; that thread closes it."""
        del self._awaited[connection]
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection, and await its first request."""
        self.await_request(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.note_arrival(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing: a browser may leave in the middle of a response."""


class _Handler(BaseHTTPRequestHandler):
    """Handler of one connection."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = _STALLED_S
    server_version = "trilight"
    sys_version = ""

    def do_GET(self) -> None:
        self._respond("GET")

    def do_POST(self) -> None:
        self._respond("POST")

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the path holds the secret token."""

    def _respond(self, method: str) -> None:
        port = self.server.server_port
        token = self.server.token
        refused = refusal(method, self.path, self.headers.items(), port=port, token=token)
        if refused is not None:
            self.close_connection = True
            self._send_sentence(*refused)
            return
        data = self.rfile.read(int(self.headers["Content-Length"])) if method == "POST" else b""
        self.server.note_arrival(self.connection)
        with self.server.slots:
            answer = self._dispatch(method, data)
        if isinstance(answer, Response):
            self._send(HTTPStatus.OK, answer)
        else:
            self._send_sentence(*answer)
        self.server.await_request(self.connection)

    def _dispatch(self, method: str, data: bytes) -> Response | Refusal:
        path, _, query = self.path.partition("?")
        below = unquote(path.removeprefix(f"/{self.server.token}")).removeprefix("/")
        try:
            body = _parse_body(data) if method == "POST" else None
            request = Request(method=method, path=below, query=dict(parse_qsl(query)), body=body)
            return dispatch(self.server.routes, request)
        except NotFound as error:
            return HTTPStatus.NOT_FOUND, str(error)
        except TrilightError as error:
            return HTTPStatus.UNPROCESSABLE_ENTITY, str(error)
        except Exception as error:
            sentence = f"The viewer cannot answer this ({type(error).__name__})."
            return HTTPStatus.INTERNAL_SERVER_ERROR, sentence

    def _send_sentence(self, status: HTTPStatus, sentence: str) -> None:
        """Send a sentence: as text where HTML is accepted, else as JSON."""
        if "text/html" in self.headers.get("Accept", ""):
            self._send(status, Response(body=sentence.encode(), kind="text/plain; charset=utf-8"))
        else:
            self._send(status, json_response({"error": sentence}))

    def _send(self, status: HTTPStatus, response: Response) -> None:
        self.send_response(status)
        headers = {"Content-Type": response.kind, "Content-Length": str(len(response.body))}
        for name, value in {**SAFE_HEADERS, **headers, **response.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(response.body)


def _parse_body(data: bytes) -> Any:
    """Return the JSON of a request; raises TrilightError for anything else, also for NaN."""
    parsers = dict.fromkeys(("parse_float", "parse_int", "parse_constant"), _parse_number)
    try:
        return json.loads(data, **parsers)  # type: ignore[arg-type]
    except (ValueError, RecursionError) as error:
        raise TrilightError("the request is no JSON with finite numbers.") from error


def _parse_number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return int(text) if text.removeprefix("-").isdecimal() else value


def refusal(
    method: str, path: str, pairs: Iterable[tuple[str, str]], *, port: int, token: str
) -> Refusal | None:
    """Return why a request is refused, or None where it is allowed.

    Args:
        path: path as it was sent, with its query.
        pairs: headers of the request, names in any case.
        port: port of the server.
        token: secret token of the address.
    """
    server_address = f"{HOST}:{port}"
    pairs = [(name.lower(), value) for name, value in pairs]
    headers = dict(pairs)
    if len(path) > MAX_PATH:
        return HTTPStatus.REQUEST_URI_TOO_LONG, "The address is too long."
    if any([name for name, _ in pairs].count(name) > 1 for name in _ONCE):
        return HTTPStatus.BAD_REQUEST, "A header is there twice."
    if headers.get("host") != server_address:
        only = f"Only http://{server_address} is answered, and no other name of this machine."
        return HTTPStatus.FORBIDDEN, only
    origin = headers.get("origin")
    site = headers.get("sec-fetch-site", "none")
    # a followed link with the whole address is allowed: the browser leaves the other page
    followed = method == "GET" and headers.get("sec-fetch-dest") == "document"
    near = site in ("none", "same-origin") or followed
    if origin not in (None, f"http://{server_address}") or not near:
        return HTTPStatus.FORBIDDEN, "Pages of other origins are not answered."
    if method == "POST" and origin is None:
        return HTTPStatus.FORBIDDEN, "The request does not say from which page it comes."
    sent_token = path.split("?")[0].removeprefix("/").split("/")[0]
    if not hmac.compare_digest(sent_token.encode(), token.encode()):
        return HTTPStatus.FORBIDDEN, "Open the whole address that `trilight view` printed."
    length = headers.get("content-length", "")
    if method == "POST" and not (length.isascii() and length.isdecimal()):
        return HTTPStatus.LENGTH_REQUIRED, "The request has no length."
    if method == "POST" and (len(length) > 9 or int(length) > MAX_BODY_BYTES):
        return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The request is too large."
    return None


def static_routes(page: str) -> dict[str, Route]:
    """Return the routes of the files below `static/`, and of the page at the root."""
    files = {
        path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*") if path.is_file()
    }

    def file(request: Request) -> Response:
        name = request.path.removeprefix("static/")
        if name not in files:
            raise NotFound("there is no such file.")
        return Response(body=files[name].read_bytes(), kind=_KINDS[files[name].suffix])

    def index(request: Request) -> Response:
        head = files["page.html"].read_bytes().replace(b"PAGE", Path(page).stem.encode())
        body = head.replace(b"BODY", files[page].read_bytes())
        return Response(body=body, kind=_KINDS[".html"])

    return {"GET ": index, "GET static/": file}
