"""A small web server for tests: counts requests, and breaks in every way that is asked of it."""

import hashlib
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, unquote_to_bytes


class Site:
    """What the server has and how it behaves; may be changed while it runs."""

    def __init__(self) -> None:
        self.url = ""
        self.files: dict[str, bytes] = {}
        """Content by the path as it stands in the request, quoted, without query."""
        self.pages: dict[str, str] = {}
        """Listings that replace the ones made from `files`."""
        self.errors: dict[str, list[int]] = {}
        """Statuses that are answered before the content, once each; negative ones stay."""
        self.forbidden: set[str] = set()
        """Files that are listed but neither described nor given."""
        self.moved: dict[str, str] = {}
        """Where else to look for a file."""
        self.delay_s = 0.0
        self.listed = True
        self.etags = True
        self.cut: dict[str, int] = {}
        """How many bytes of a file are sent before the connection ends."""
        self.without_length: set[str] = set()
        self.silent: set[str] = set()
        """Files that are never answered."""
        self.requests: list[tuple[str, str]] = []
        self.headers: list[dict[str, str]] = []
        self.busy = 0
        self.most_busy = 0
        self.closing = threading.Event()
        self.lock = threading.Lock()

    def put(self, name: str, data: bytes | str = "v 0 0 0\n") -> None:
        """Serve a file under a name that is not yet quoted."""
        self.files[f"/{quote(name)}"] = data.encode() if isinstance(data, str) else data

    def gets(self) -> Counter[str]:
        """Return how often each path was asked for its content, queries left out."""
        asked = (path.partition("?")[0] for kind, path in self.requests if kind == "GET")
        return Counter(quote(unquote_to_bytes(path)) for path in asked)

    def page(self, path: str) -> str | None:
        """Return the listing of a folder."""
        if path in self.pages:
            return self.pages[path]
        inner = {name[len(path) :] for name in self.files if name.startswith(path)}
        if not self.listed or not path.endswith("/") or not inner:
            return None
        entries = {name.split("/")[0] + ("/" if "/" in name else "") for name in inner}
        return "".join(f'<li><a href="{entry}">x</a>' for entry in ["../", *sorted(entries)])


class _Handler(BaseHTTPRequestHandler):
    site: Site
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self._answer()

    def do_GET(self) -> None:
        self._answer()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    def _answer(self) -> None:
        # Clients may quote as little or as much as they like; the kit knows one way.
        site, path = self.site, quote(unquote_to_bytes(self.path.partition("?")[0]))
        with site.lock:
            site.requests.append((self.command, self.path))
            site.headers.append(dict(self.headers))
            site.busy += 1
            site.most_busy = max(site.most_busy, site.busy)
            waiting = site.errors.get(path, [])
            status = 403 if path in site.forbidden else 0
            if waiting and self.command == "GET":
                status = waiting[0] if waiting[0] < 0 else waiting.pop(0)
        try:
            self._reply(path, abs(status))
        finally:
            with site.lock:
                site.busy -= 1

    def _reply(self, path: str, status: int) -> None:
        site = self.site
        page = site.page(path)
        data = site.files.get(path, page.encode() if page is not None else None)
        time.sleep(site.delay_s)
        if path in site.silent and self.command == "GET":
            site.closing.wait(20)
            self.close_connection = True
            return
        if status or data is None or path in site.moved:
            self.send_response(status or (302 if path in site.moved else 404))
            self.send_header("Location", site.moved.get(path, "/"))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html" if path not in site.files else "model/x")
        if path in site.without_length:
            self.close_connection = True
        else:
            self.send_header("Content-Length", str(len(data)))
        if site.etags and path in site.files:
            self.send_header("ETag", f'"{hashlib.sha256(data).hexdigest()[:8]}"')
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data[: site.cut.get(path)])
            self.close_connection |= path in site.cut


@contextmanager
def serve() -> Iterator[Site]:
    """Run a server on a free port of the loopback; `Site.url` has no final slash."""
    site = Site()
    handler = type("Handler", (_Handler,), {"site": site})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    site.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield site
    finally:
        site.closing.set()
        server.shutdown()
        thread.join()
        server.server_close()
