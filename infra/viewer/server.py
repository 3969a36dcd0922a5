"""The server of a page: answers guarded requests from a table of routes, on this machine alone."""

import contextlib
import json
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, unquote

from infra.viewer.guard import HOST, SAFE_HEADERS, new_word, refusal
from storage.errors import TrilightError

MOST_CONNECTIONS = 32
"""Requests that are answered at a time; a browser opens six, and more wait."""

_REQUEST_S = 15.0
"""Time in which a whole request must arrive; a connection without one is closed then."""

_MOST_AWAITED = 64
"""Connections without a whole request; for each further one, the oldest of them is closed."""

_STALLED_S = 30.0
"""A browser that takes nothing for so long is left."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a request gets."""

    body: bytes
    kind: str = "application/json"
    """Media type."""
    headers: Mapping[str, str] = field(default_factory=dict)
    """Further ones."""


def json_answer(value: Any) -> Answer:
    """Return a value as JSON."""
    return Answer(body=json.dumps(value, allow_nan=False).encode())


@dataclass(frozen=True, kw_only=True)
class Question:
    """A request that may pass."""

    path: str
    """Below the password, decoded, without the first slash."""
    query: Mapping[str, str]
    """What stands behind the question mark."""
    body: Any = None
    """JSON of a POST."""


class NotThere(TrilightError):
    """There is nothing at a path."""


Route = Callable[[Question], Answer]
"""Answers the requests of one path, or of all paths below a prefix that ends in a slash; raises
TrilightError with a sentence for the page, NotThere where there is nothing."""


def routed(routes: Mapping[str, Route], question: Question) -> Answer:
    """Return what the route of a question answers; raises TrilightError as a `Route` does."""
    path = question.path
    for prefix, route in routes.items():
        if path == prefix or (prefix.endswith("/") and path.startswith(prefix)):
            return route(question)
    raise NotThere(f"{path or 'the page'}: nothing is there.")


class PageServer(ThreadingHTTPServer):
    """Listens on loopback; `address` is what a person opens."""

    daemon_threads = True
    request_queue_size = 64

    def __init__(
        self, gets: Mapping[str, Route], posts: Mapping[str, Route], *, port: int = 0
    ) -> None:
        """Take a port; 0 for any that is free.

        Raises:
            TrilightError: the port is taken.
        """
        self.gets = gets
        self.posts = posts
        self.word = new_word()
        self.places = threading.BoundedSemaphore(MOST_CONNECTIONS)
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
        """URL with the password."""
        return f"http://{HOST}:{self.server_port}/{self.word}/"

    def await_request(self, connection: socket.socket) -> None:
        """Take notice that a connection has no request yet; of too many, close the oldest."""
        with self._changing:
            self._awaited[connection] = time.monotonic()
            if len(self._awaited) > _MOST_AWAITED:
                self._end(next(iter(self._awaited)))

    def note_arrival(self, connection: socket.socket) -> None:
        """Take notice that a connection has a whole request, or has ended."""
        with self._changing:
            self._awaited.pop(connection, None)

    def service_actions(self) -> None:
        """Close connections whose request takes too long; called twice a second."""
        with self._changing:
            before = time.monotonic() - _REQUEST_S
            for connection in [key for key, began in self._awaited.items() if began < before]:
                self._end(connection)

    def _end(self, connection: socket.socket) -> None:
        """Wake the thread that reads from a connection, which closes it."""
        del self._awaited[connection]
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Await the first request of a connection, in a thread of its own."""
        self.await_request(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.note_arrival(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that goes away in the middle of an answer is no news."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = _STALLED_S
    server_version = "trilight"
    sys_version = ""

    def do_GET(self) -> None:
        self._answer("GET")

    def do_POST(self) -> None:
        self._answer("POST")

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the path holds the password."""

    def _answer(self, method: str) -> None:
        port = self.server.server_port
        word = self.server.word
        refused = refusal(method, self.path, self.headers.items(), port=port, word=word)
        if refused is not None:
            self.close_connection = True
            self._say(refused.status, refused.sentence)
            return
        data = self.rfile.read(int(self.headers["Content-Length"])) if method == "POST" else b""
        self.server.note_arrival(self.connection)
        status = HTTPStatus.OK
        with self.server.places:
            try:
                answer = self._routed(method, data)
            except NotThere as error:
                status = HTTPStatus.NOT_FOUND
                sentence = str(error)
            except TrilightError as error:
                status = HTTPStatus.UNPROCESSABLE_ENTITY
                sentence = str(error)
            except Exception as error:
                status = HTTPStatus.INTERNAL_SERVER_ERROR
                sentence = f"The viewer cannot answer this ({type(error).__name__})."
        if status == HTTPStatus.OK:
            self._send(status, answer)
        else:
            self._say(status, sentence)
        self.server.await_request(self.connection)

    def _routed(self, method: str, data: bytes) -> Answer:
        path, _, query = self.path.partition("?")
        below = unquote(path.removeprefix(f"/{self.server.word}")).removeprefix("/")
        body = _parse_body(data) if method == "POST" else None
        question = Question(path=below, query=dict(parse_qsl(query)), body=body)
        return routed(self.server.posts if method == "POST" else self.server.gets, question)

    def _say(self, status: HTTPStatus, sentence: str) -> None:
        """Send a sentence: to a script as JSON, to a person as text."""
        if "text/html" in self.headers.get("Accept", ""):
            self._send(status, Answer(body=sentence.encode(), kind="text/plain; charset=utf-8"))
        else:
            self._send(status, json_answer({"error": sentence}))

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        self.send_response(status)
        headers = {"Content-Type": answer.kind, "Content-Length": str(len(answer.body))}
        for name, value in {**SAFE_HEADERS, **headers, **answer.headers}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(answer.body)


def _parse_body(data: bytes) -> Any:
    """Return the JSON of a request; raises TrilightError for anything else, NaN and infinities."""
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
