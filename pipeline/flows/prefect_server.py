"""A private Prefect server for runs that nobody has started a server for.

Prefect's own temporary server outlives a parent that is killed. This one asks the kernel to end
with its parent, keeps its database in Trilight's cache, binds to loopback, wants a password that
only this run knows (pipeline.flows.guarded_server), and is quiet. Where PREFECT_API_URL is set (a
served deployment, a team's server) that server is used instead.
"""

import contextlib
import fcntl
import http.client
import os
import secrets
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from storage.cache import cache_folder, open_private, private_folder
from storage.errors import TrilightError
from storage.installation import IMPORT_ROOT, child_environment

TOLD_BY_ITS_STARTER = "TRILIGHT_TOLD_BY_ITS_STARTER"
"""In the environment of processes that get SIGTERM from who started them, and from nobody else."""
PASSWORD = "PREFECT_SERVER_API_AUTH_STRING"
"""Variable of a server with USER:PASSWORD, which every request must name."""
CLIENT_PASSWORD = "PREFECT_API_AUTH_STRING"
"""Variable of who sends requests, with the same."""
_START_UP_S = 120.0
_LOG_NAME = "server.log"
SERVER = (sys.executable, "-m", f"{__package__}.guarded_server")
"""Program of every server that we start; --host and --port follow."""


def quiet_prefect() -> None:
    """Set what Prefect reads when it is imported: no telemetry, a private home, no chatter.

    Call before the first import of prefect. What the user has set already is kept.
    """
    quiet = {
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_HOME": str(cache_folder("prefect")),
        "PREFECT_LOGGING_LEVEL": "CRITICAL",
        "PREFECT_CLI_PROMPT": "false",
        "PREFECT_SHOW_BANNER": "false",
    }
    for name, value in quiet.items():
        os.environ.setdefault(name, value)


@contextlib.contextmanager
def prefect_server() -> Iterator[str]:
    """Provide the URL of a Prefect API for the block, and set PREFECT_API_URL to it.

    Raises:
        TrilightError: the private server does not start.
    """
    if given := os.environ.get("PREFECT_API_URL"):
        yield given
        return
    home = private_folder(Path(os.environ["PREFECT_HOME"]))
    password = new_password()
    with (home / "start.lock").open("w") as lock, open_private(home / _LOG_NAME, "ab") as log:
        fcntl.flock(lock, fcntl.LOCK_EX)  # two first starts at once would both migrate the database
        port = _free_port()
        server = subprocess.Popen(
            [*SERVER, "--port", str(port), "--with-parent"],
            env={**child_environment(), PASSWORD: password, "PREFECT_UI_ENABLED": "false"},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=IMPORT_ROOT,
        )
        url = f"http://127.0.0.1:{port}/api"
        try:
            wait_until_healthy(url, server, home / _LOG_NAME)
            fcntl.flock(lock, fcntl.LOCK_UN)
            os.environ |= {"PREFECT_API_URL": url, CLIENT_PASSWORD: password}
            yield url
        finally:
            for variable in ("PREFECT_API_URL", CLIENT_PASSWORD):
                os.environ.pop(variable, None)
            server.kill()  # its records are a display, not the truth: nothing is waited for
            server.wait()


def new_password() -> str:
    """Return USER:PASSWORD that nobody can guess."""
    return f"trilight:{secrets.token_urlsafe(24)}"


def wait_until_healthy(url: str, server: "subprocess.Popen[bytes]", log: Path) -> None:
    """Return when a server answers; raises TrilightError where it ends, or takes too long."""
    deadline = time.monotonic() + _START_UP_S
    while time.monotonic() < deadline and server.poll() is None:
        with contextlib.suppress(urllib.error.URLError, OSError, http.client.HTTPException):
            with urllib.request.urlopen(f"{url}/health", timeout=2):
                if server.poll() is None:  # else it was somebody else who answered
                    return
        time.sleep(0.1)
    raise TrilightError(
        f"Prefect: the server did not start within {_START_UP_S:.0f} s, or ended; see {log}, and "
        "try `trilight doctor`."
    )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
