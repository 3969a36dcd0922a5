"""Starts a private Prefect server for a run, unless PREFECT_API_URL names one.

Prefect's own temporary server outlives a parent that is killed. This one asks the kernel to end
with its parent, keeps its database in Trilight's cache, binds to loopback, requires a password that
only this run knows (pipeline.flows.guarded_server), and prints nothing. If PREFECT_API_URL is set
(a served deployment, a team's server), that server is used instead.
"""

import contextlib
import io
import json
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.isolation import die_with_parent
from storage.cache import cache_folder, open_private, private_folder
from storage.errors import TrilightError
from storage.file_locks import hold_lock
from storage.installation import IMPORT_ROOT, child_environment
from storage.remote.url import safe_text

DISK_LIMIT = "trilight-disk"
"""Limit of runs that write documents at the same time."""
GPU_LIMIT = "trilight-gpu"
"""Limit of tasks that render or train on a GPU at the same time. A limit that does not exist at the
server has no effect, so the setup of a server creates both (infra.serving.deployments)."""

if TYPE_CHECKING:
    import httpx
    from prefect.client.orchestration import SyncPrefectClient

STOPPED_BY_PARENT = "TRILIGHT_TOLD_BY_ITS_STARTER"
"""Variable that marks a process which gets SIGTERM from its parent, and from no other process."""
PASSWORD = "PREFECT_SERVER_API_AUTH_STRING"
"""Variable of the server: USER:PASSWORD, which every request must state."""
CLIENT_PASSWORD = "PREFECT_API_AUTH_STRING"
"""Variable of the client, with the same value."""
_NO_PAGE = {
    "PREFECT_UI_ENABLED": "false",
    "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": "false",
    "PREFECT_SERVER_MEMOIZE_BLOCK_AUTO_REGISTRATION": "false",
}
"""Variables of a server without its page, and without the blocks of that page, which are slow."""
_START_UP_S = 600.0
_SIGN_OF_LIFE_S = 15.0
_LOG_NAME = "server.log"
SERVER = (sys.executable, "-m", f"{__package__}.guarded_server")
"""Program of every server that we start; --host and --port follow."""


def quiet_prefect() -> None:
    """Set Prefect's environment variables: no telemetry, a private home, no log output.

    Call before the first import of prefect. Variables that the user has set are kept.
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
    _ensure_home()


def _ensure_home() -> None:
    """Set HOME, which Prefect needs on import, where neither it nor a passwd entry states one."""
    if os.path.expanduser("~") == "~":
        os.environ["HOME"] = str(cache_folder("home"))


def load_prefect() -> None:
    """Import Prefect, which reads its settings from environment, profile and working folder.

    Raises:
        TrilightError: Prefect refuses a setting, or there is neither a home nor a cache.
    """
    existing = [os.environ.get(name) for name in ("no_proxy", "NO_PROXY")]
    os.environ["no_proxy"] = ",".join([*filter(None, existing), "localhost", "127.0.0.1"])
    _ensure_home()
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # it prints the error too
            from prefect.settings import get_current_settings

            get_current_settings()
    except (ValueError, OSError) as error:
        fields: Any = getattr(error, "errors", lambda: ())()  # of pydantic, without the values
        said = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in fields] or [str(error)]
        raise TrilightError(
            f"Prefect refuses its settings ({'; '.join(said)}); expected valid ones. Correct the "
            "variables PREFECT_*, its profile, or prefect.toml, pyproject.toml or .env here."
        ) from error


@contextlib.contextmanager
def name_prefect_failures(
    next_step: str = "Run make serve, or fix PREFECT_API_URL",
) -> Iterator[None]:
    """Convert errors of a Prefect server within the block to TrilightError with one sentence."""
    import httpx
    from prefect.exceptions import PrefectException
    from prefect.settings import get_current_settings

    server = f"Prefect at {safe_text(get_current_settings().api.url or '')}"
    try:
        yield
    except httpx.HTTPStatusError as refusal:
        status = refusal.response.status_code
        reason = (
            "it requires a password. Set PREFECT_API_AUTH_STRING=USER:PASSWORD"
            if status in (401, 403)
            else f"it answers {status}: {_detail(refusal.response)}"
        )
        raise TrilightError(f"{server}: {reason}.") from refusal
    except (httpx.TransportError, httpx.InvalidURL, PrefectException) as trouble:
        said = re.sub(r"^\[Errno -?\d+\] ", "", safe_text(str(trouble))).rstrip(".")
        raise TrilightError(f"{server}: {said or 'no answer'}. {next_step}.") from trouble


@contextlib.contextmanager
def prefect_client() -> Iterator["SyncPrefectClient"]:
    """Provide a client of the configured Prefect server, after a check that it answers.

    Raises:
        TrilightError: the server refuses or does not answer, or certificates cannot be read.
    """
    from prefect.client.orchestration import get_client

    with name_prefect_failures():
        try:
            opened = get_client(sync_client=True)
        except OSError as error:
            raise TrilightError(
                f"Prefect: the file of certificates cannot be read ({error.strerror}); expected "
                "one in PEM. Correct or unset SSL_CERT_FILE and PREFECT_API_SSL_CERT_FILE."
            ) from error
        with opened as client:
            try:
                version = client.api_version()
            except ValueError:
                version = ""
            if not isinstance(version, str) or not version[:1].isdigit():
                raise TrilightError(
                    f"{safe_text(str(client.api_url))} is no API of Prefect; expected one, such "
                    "as http://127.0.0.1:4200/api. Run make serve, or fix PREFECT_API_URL."
                )
            yield client


def _detail(response: "httpx.Response") -> str:
    """Return the server's reason of an error, such as the name of a wrong parameter."""
    try:
        detail = response.json().get("detail", "")
    except ValueError:
        detail = response.text
    text = detail if isinstance(detail, str) else json.dumps(detail)
    return safe_text(text)[:500] or "no reason given"


@contextlib.contextmanager
def prefect_server() -> Iterator[str]:
    """Provide the URL of a Prefect API for the block, and set PREFECT_API_URL to it.

    Raises:
        TrilightError: the configured server does not answer, or the private one does not start;
            also for errors of the server within the block.
    """
    if configured := os.environ.get("PREFECT_API_URL"):
        load_prefect()
        with prefect_client():
            pass
        with name_prefect_failures():
            yield configured
        return
    home = private_folder(Path(os.environ["PREFECT_HOME"]))
    password = new_password()
    with contextlib.ExitStack() as starting, open_private(home / _LOG_NAME, "ab") as log:
        # two first starts at once would both migrate the database
        starting.enter_context(hold_lock(home / "start.lock", wait=True))
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        server = subprocess.Popen(
            [*SERVER, "--port", str(port), "--with-parent"],
            env={**child_environment(), PASSWORD: password, **_NO_PAGE},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=IMPORT_ROOT,
        )
        url = f"http://127.0.0.1:{port}/api"
        try:
            wait_until_healthy(url, server, home / _LOG_NAME)
            starting.close()
            os.environ |= {"PREFECT_API_URL": url, CLIENT_PASSWORD: password}
            load_prefect()
            with prefect_client():
                pass
            with name_prefect_failures(f"See {home / _LOG_NAME}; run the command again to go on"):
                yield url
        finally:
            for variable in ("PREFECT_API_URL", CLIENT_PASSWORD):
                os.environ.pop(variable, None)
            server.kill()  # its records are a display, not the truth: nothing is waited for
            server.wait()


def new_password() -> str:
    """Return USER:PASSWORD with a random password."""
    return f"trilight:{secrets.token_urlsafe(24)}"


def wait_until_healthy(
    url: str,
    server: "subprocess.Popen[bytes]",
    log: Path,
    say: Callable[[str], None] = lambda text: None,
) -> None:
    """Wait until a server answers; raises TrilightError if it ends or takes too long.

    Args:
        say: gets a sign of life every _SIGN_OF_LIFE_S seconds.
    """
    began = time.monotonic()
    deadline = began + _START_UP_S
    next_sign = began + _SIGN_OF_LIFE_S
    import httpx

    while time.monotonic() < deadline and server.poll() is None:
        with contextlib.suppress(httpx.HTTPError):  # no proxy: it is on this machine
            answer = httpx.get(f"{url}/health", timeout=2, trust_env=False)
            if answer.is_success and server.poll() is None:  # else another server answered here
                return
        if (now := time.monotonic()) >= next_sign:
            next_sign = now + _SIGN_OF_LIFE_S
            say(f"the server is still starting: {now - began:.0f} of at most {_START_UP_S:.0f} s")
        time.sleep(0.1)
    load_prefect()  # raises if a setting made the server fail
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    said = safe_text(lines[-1]) if lines else "without a word"
    ended = f"it ended ({said}); see {log}, and try `trilight doctor`."
    silent = (
        f"it did not answer within {_START_UP_S:.0f} s ({said}); see {log}, and repeat the command "
        "when this machine is less busy."
    )
    why = silent if server.poll() is None else ended
    raise TrilightError(f"Prefect: the server did not start: {why}")


def run_to_end(command: Sequence[str], say: Callable[[str], None]) -> tuple[int, str]:
    """Run a program and pass on its output.

    If this call ends early (a canceled flow gets SIGTERM, which Prefect raises as an exception),
    the program gets one SIGTERM, and the call waits for it. It has a session of its own, so that no
    signal to the group of this process reaches it too: training ends at once after a second signal.
    If this process is killed, the program is too.

    Args:
        say: called with each line of the output, without secrets.

    Returns:
        The exit status of the program, and its last line.
    """
    last = ""
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**child_environment(), STOPPED_BY_PARENT: "1"},
        start_new_session=True,
        preexec_fn=die_with_parent,
    ) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.strip():
                    last = safe_text(line.strip())
                    say(last)
        except BaseException:
            process.send_signal(signal.SIGTERM)
            process.communicate()  # a full pipe would stop it before it has saved
            raise
    return process.returncode, last
