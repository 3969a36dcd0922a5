"""As much of the Hugging Face hub as an upload asks for; what is committed lies in a folder."""

import base64
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

LARGE = (".tar", ".safetensors")
"""Files that go by themselves; all others go within the commit."""


class _Handler(BaseHTTPRequestHandler):
    root: Path
    token: str
    made: list[dict[str, Any]]
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer({"id": "ada/set", "sha": "0" * 40, "siblings": [], "private": False})

    def do_PUT(self) -> None:
        place = self.root / ".objects" / self.path.rpartition("/")[2]
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(self._body())
        self._answer({})

    def do_POST(self) -> None:
        body = self._body()
        if self.headers["Authorization"] != f"Bearer {self.token}":
            self._answer({"error": "Invalid username or password."}, status=401)
        elif self.path == "/api/repos/create":
            asked = json.loads(body)
            self.made.append(asked)
            kind = {"model": ""}.get(asked.get("type", "model"), f"{asked.get('type')}s/")
            name = f"{asked['organization']}/{asked['name']}"
            self._answer({"url": f"{self._here}/{kind}{name}", "name": name, "id": "1"})
        elif self.path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            names = [entry["path"] for entry in json.loads(body)["files"]]
            self._answer({"files": [self._mode(name) for name in names]})
        elif self.path.endswith("/objects/batch"):
            wanted = json.loads(body)["objects"]
            self._answer({"transfer": "basic", "objects": [self._place(each) for each in wanted]})
        else:
            assert "/commit/" in self.path, self.path
            self._commit(body)
            self._answer(
                {"commitOid": "1" * 40, "commitUrl": f"{self._here}/datasets/ada/set/commit/1"}
            )

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""

    @property
    def _here(self) -> str:
        return f"http://{self.headers['Host']}"

    def _body(self) -> bytes:
        return self.rfile.read(int(self.headers["Content-Length"] or 0))

    def _mode(self, name: str) -> dict[str, Any]:
        mode = "lfs" if name.endswith(LARGE) else "regular"
        return {"path": name, "uploadMode": mode, "shouldIgnore": False}

    def _place(self, wanted: dict[str, Any]) -> dict[str, Any]:
        upload = {"href": f"{self._here}/put/{wanted['oid']}"}
        return {"oid": wanted["oid"], "size": wanted["size"], "actions": {"upload": upload}}

    def _commit(self, body: bytes) -> None:
        for line in map(json.loads, body.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                data = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                data = (self.root / ".objects" / value["oid"]).read_bytes()
            else:
                continue
            place = self.root / value["path"]
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(data)

    def _answer(self, value: object, *, status: int = 200) -> None:
        body = json.dumps(value).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@contextmanager
def hub_for_uploads(root: Path, token: str) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Run the server on a free port; returns its URL and what repositories it was asked to make."""
    made: list[dict[str, Any]] = []
    handler = type("Handler", (_Handler,), {"root": root, "token": token, "made": made})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", made
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def settings_of(url: str, token: str, home: Path) -> dict[str, str]:
    """Return the environment of a process that uploads there, and touches nothing of the user's."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    quiet = {"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
    return {**kept, **quiet, "HF_ENDPOINT": url, "HF_TOKEN": token, "HF_HOME": str(home)}
