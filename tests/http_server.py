"""Web servers of tests: any handler, and files of memory or a folder with all breakages."""

import hashlib
import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote, unquote_to_bytes


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What goes wrong with one answer to a GET."""

    status: int = 0
    """Answered instead of the content."""
    cut_after: int | None = None
    """Bytes after which the connection ends."""
    trickle: tuple[int, float] | None = None
    """Bytes that come at once, and seconds before the next ones."""
    stall_after: int | None = None
    """Bytes after which nothing more comes."""
    silent: bool = False
    """Nothing comes at all."""
    flip: bool = False
    """One bit in the middle is another."""
    no_length: bool = False
    """The answer does not say how long it is: its end is the end of the connection."""
    other_part: bool = False
    """The part that is sent begins one byte late, and says so."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What somebody asked for."""

    kind: str
    """GET or HEAD."""
    path: str
    """As it was sent, with its query."""
    headers: dict[str, str]
    """As they were sent."""

    @property
    def name(self) -> str:
        """The path in the one way of quoting that this server knows, without query."""
        # Clients may quote as little or as much as they like.
        return quote(unquote_to_bytes(self.path.partition("?")[0]))


class Site:
    """What the server has and how it behaves; may be changed while it runs.

    Files go by their path as it stands in the request: quoted, with a slash before it.
    """

    def __init__(self, root: Path | None = None) -> None:
        self.url = ""
        self.files: dict[str, bytes] = {}
        self.root = root
        """A folder whose files are served too."""
        self.pages: dict[str, str] = {}
        """Listings that replace the ones made from `files`."""
        self.faults: dict[str, list[Fault]] = {}
        """One for each GET in turn; after the last one all is well."""
        self.always: dict[str, Fault] = {}
        """For every GET."""
        self.forbidden: set[str] = set()
        """Files that are listed but neither described nor given."""
        self.moved: dict[str, str] = {}
        """Where else to look for a file."""
        self.needed_query: str | None = None
        """Without it nothing is given."""
        self.delay_s = 0.0
        self.listed = True
        self.etags = True
        self.ranges = True
        self.requests: list[Request] = []
        self.sent = 0
        """Bytes of content that went out."""
        self.busy = 0
        self.most_busy = 0
        self.closing = threading.Event()
        self.lock = threading.Lock()

    def put(self, name: str, data: bytes | str = "v 0 0 0\n") -> None:
        """Serve a file under a name that is not yet quoted."""
        self.files[f"/{quote(name)}"] = data.encode() if isinstance(data, str) else data

    def gets(self) -> Counter[str]:
        """Return how often each path was asked for its content."""
        return Counter(request.name for request in self.requests if request.kind == "GET")

    def ranges_of(self, path: str) -> list[str]:
        """Return from where on a file was asked for, each time."""
        gets = (each for each in self.requests if (each.kind, each.name) == ("GET", path))
        return [request.headers.get("Range", "") for request in gets]

    def content(self, path: str) -> bytes | None:
        """Return a file, or the listing of a folder."""
        if path in self.files:
            return self.files[path]
        file = None if self.root is None else self.root / unquote(path).lstrip("/")
        if file is not None and file.is_file():
            return file.read_bytes()
        page = self.page(path)
        return None if page is None else page.encode()

    def page(self, path: str) -> str | None:
        """Return the listing of a folder."""
        if path in self.pages:
            return self.pages[path]
        inner = {name[len(path) :] for name in self.files if name.startswith(path)}
        if not self.listed or not path.endswith("/") or not inner:
            return None
        entries = {name.split("/")[0] + ("/" if "/" in name else "") for name in inner}
        return "".join(f'<li><a href="{entry}">x</a>' for entry in ["../", *sorted(entries)])

    def fault_of(self, request: Request) -> Fault:
        """Return what goes wrong with an answer, which uses it up."""
        always, path = self.always.get(request.name), request.name
        query = request.path.partition("?")[2]
        if path in self.forbidden or self.needed_query not in (None, query):
            return Fault(status=403)
        if request.kind == "HEAD":
            return Fault(no_length=always is not None and always.no_length)
        with self.lock:
            return always or (self.faults[path].pop(0) if self.faults.get(path) else Fault())


class Handler(BaseHTTPRequestHandler):
    """Answers without a word on standard error."""

    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def reply(self, status: int, body: bytes, **headers: str) -> None:
        """Answer as a whole; underscores in the names of headers stand for hyphens."""
        self.send_response(status)
        for name, value in {**headers, "Content_Length": str(len(body))}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def reply_json(self, value: object, status: int = 200) -> None:
        """Answer with a document."""
        self.reply(status, json.dumps(value).encode(), Content_Type="application/json")


@contextmanager
def running(handler: type[Handler], **given: object) -> Iterator[str]:
    """Run a server, whose handlers have these attributes; give its URL on the loopback."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Given", (handler,), given))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


class _SiteHandler(Handler):
    site: Site

    def do_GET(self) -> None:
        site = self.site
        request = Request(kind=self.command, path=self.path, headers=dict(self.headers))
        with site.lock:
            site.requests.append(request)
            site.busy += 1
            site.most_busy = max(site.most_busy, site.busy)
        try:
            time.sleep(site.delay_s)
            self._reply(request.name, site.fault_of(request))
        finally:
            with site.lock:
                site.busy -= 1

    do_HEAD = do_GET

    def _reply(self, path: str, fault: Fault) -> None:
        data = self.site.content(path)
        if fault.silent:
            self.site.closing.wait(20)
            self.close_connection = True
        elif fault.status or data is None or path in self.site.moved:
            status = fault.status or (302 if path in self.site.moved else 404)
            self.reply(status, b"", Location=self.site.moved.get(path, "/"))
        else:
            self._send(path, bytearray(data), fault)

    def _first(self, fault: Fault) -> int:
        asked = self.headers.get("Range", "")
        if not self.site.ranges or not asked.endswith("-"):
            return 0
        return int(asked.removeprefix("bytes=").removesuffix("-")) + fault.other_part

    def _send(self, path: str, data: bytearray, fault: Fault) -> None:
        first, is_page = self._first(fault), path.endswith("/")
        etag = hashlib.sha256(data).hexdigest()[:8]
        if fault.flip:
            data[(first + len(data)) // 2] ^= 1
        self.send_response(206 if first else 200)
        self.send_header("Content-Type", "text/html" if is_page else "model/x")
        if first:
            self.send_header("Content-Range", f"bytes {first}-{len(data) - 1}/{len(data)}")
        if not fault.no_length:
            self.send_header("Content-Length", str(len(data) - first))
        if self.site.etags and not is_page:
            self.send_header("ETag", f'"{etag}"')
        self.end_headers()
        stop = fault.cut_after if fault.stall_after is None else fault.stall_after
        self.close_connection |= stop is not None or fault.no_length
        if self.command == "HEAD":
            return
        body = data[first:][:stop]
        step, pause_s = fault.trickle or (max(len(body), 1), 0.0)
        for start in range(0, len(body), step):
            piece = body[start : start + step]
            with self.site.lock:  # counted first: who asked may look as soon as he has the last one
                self.site.sent += len(piece)
            self.wfile.write(piece)
            if self.site.closing.wait(pause_s):
                break
        if fault.stall_after is not None:
            self.site.closing.wait(20)


@contextmanager
def serve(root: Path | None = None) -> Iterator[Site]:
    """Run a server on a free port of the loopback; `Site.url` has no final slash."""
    site = Site(root)
    with running(_SiteHandler, site=site) as site.url:
        try:
            yield site
        finally:
            site.closing.set()
