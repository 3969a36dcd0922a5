"""HTTP server of a page on loopback: guards requests, and dispatches them by a table of routes.

The address holds a secret token, as the first component of every path. A browser sends the host
name of its request and the origin of the requesting page. Both must be those of this server, so
that DNS rebinding and a guessed port fail. Static files are listed when the server starts, so that
a request's path only selects from a list.
"""

import asyncio
import hmac
import json
import math
import secrets
import socket
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import uvicorn
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request as HttpRequest
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
)
from starlette.types import Receive, Scope, Send

from pipeline.flows import guarded_server
from storage.errors import TrilightError

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


class PageServer:
    """Server on loopback; `address` is the URL to open."""

    def __init__(self, routes: Routes, *, port: int = 0) -> None:
        """Listen on a port; 0 stands for any free one.

        Raises:
            TrilightError: the port cannot be used.
        """
        self.routes = routes
        self.token = secrets.token_urlsafe(24)
        try:
            self._socket = socket.create_server((HOST, port))
        except OSError as error:
            raise TrilightError(
                f"--port is {port}, which cannot be listened at ({error.strerror}); expected a "
                "free port, or none, and one is found."
            ) from error
        self.port = int(self._socket.getsockname()[1])
        config = uvicorn.Config(
            self._respond,
            interface="asgi3",
            http=guarded_server.request_timeout_protocol(),
            lifespan="off",
            ws="none",
            log_level="critical",  # a line would hold the secret token
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)

    @property
    def address(self) -> str:
        """URL of the page, with the secret token."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    def run(self) -> None:
        """Answer requests until `close` is called."""
        with self._socket:
            self._server.run(sockets=[self._socket])

    def close(self) -> None:
        """Let `run` return, after a second also where responses are not complete."""
        self._server.should_exit = True

    async def _respond(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the response to a request; uvicorn calls it."""
        sent = HttpRequest(scope, receive)
        path = b"?".join(filter(None, (scope["raw_path"], scope["query_string"]))).decode("latin-1")
        pairs = sent.headers.items()
        refused = refusal(sent.method, path, pairs, port=self.port, token=self.token)
        response = await self._answer(sent) if refused is None else _sentence(sent, *refused)
        response.headers.update(SAFE_HEADERS)
        if refused is not None:
            response.headers["Connection"] = "close"
        await response(scope, receive, send)

    async def _answer(self, sent: HttpRequest) -> Response:
        """Return the response to a request that passed the guard."""
        try:
            is_post = sent.method == "POST"
            data = await asyncio.wait_for(sent.body(), guarded_server.REQUEST_S) if is_post else b""
            request = Request(
                method=sent.method,
                path=sent.url.path.removeprefix(f"/{self.token}").removeprefix("/"),
                query=dict(parse_qsl(sent.url.query)),
                body=_parse_body(data) if is_post else None,
            )
            return await run_in_threadpool(dispatch, self.routes, request)
        except NotFound as error:
            return _sentence(sent, HTTPStatus.NOT_FOUND, str(error))
        except TrilightError as error:
            return _sentence(sent, HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except Exception as error:
            sentence = f"The viewer cannot answer this ({type(error).__name__})."
            return _sentence(sent, HTTPStatus.INTERNAL_SERVER_ERROR, sentence)


def _sentence(sent: HttpRequest, status: HTTPStatus, sentence: str) -> Response:
    """Return a sentence as a response: as text where HTML is accepted, else as JSON."""
    if "text/html" in sent.headers.get("accept", ""):
        return PlainTextResponse(sentence, status)
    return JSONResponse({"error": sentence}, status)


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
    if method not in ("GET", "POST"):
        return HTTPStatus.NOT_IMPLEMENTED, "Only GET and POST are answered."
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
    is_stated = length.isascii() and length.isdecimal() and "transfer-encoding" not in headers
    if method == "POST" and not is_stated:
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
        return FileResponse(files[name])

    def index(request: Request) -> Response:
        head = files["page.html"].read_bytes().replace(b"PAGE", Path(page).stem.encode())
        body = head.replace(b"BODY", files[page].read_bytes())
        return HTMLResponse(body)

    return {"GET ": index, "GET static/": file}
