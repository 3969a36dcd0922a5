"""`make serve` and `make stop`: Prefect's server, a pool, workers and deployments on this machine.

Everything binds to loopback, unless TRILIGHT_HOST says otherwise. The server only answers requests
with the password of this start, its own host name and its own origin
(pipeline.flows.guarded_server): other users of this machine, its containers and the pages in its
user's browser can reach loopback, too.

Prefect's commands read `prefect.toml` in the folder where they run. So the server's URL and
password are in a file of that name in the state folder (mode 0600), and the checkout holds a link
to it: every command of the documents works from the checkout without exported variables, no copy of
the checkout holds the password, and `make stop` deletes it. If TRILIGHT_STATE names another state
folder, there is no link, since a second server must not take the commands away from the first.

Prefect has no roles. The password gives access to the whole API, and by new deployments and pools
to everything that the worker's account can do: share it only with users who may have that account.
Against accidents, stolen forms and careless automation, a run of these flows takes only parameters
(infra/serving/pool.json and the other templates leave no choice of command, image, environment or
working folder), Prefect checks the parameters by the flow's form, and no parameter names a program.
Parameters do name paths: `out` may be any folder that the worker may write, `objects` and `data`
any that it may read.

Started processes carry a mark in their environment, which flow runs and their children inherit, so
that `stop` ends exactly those, also after a worker was killed, and no other process. Several
workers share the cores and the GPUs evenly. The database is SQLite, or that of
PREFECT_API_DATABASE_CONNECTION_URL.
"""

import contextlib
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from infra.serving.deployments import whole_number
from pipeline.flows.guarded_server import NAMES
from pipeline.flows.prefect_server import (
    CLIENT_PASSWORD,
    PASSWORD,
    SERVER,
    STOPPED_BY_PARENT,
    new_password,
    quiet_prefect,
    wait_until_healthy,
)
from pipeline.renders.mitsuba_variant import visible_gpus
from storage.atomic import write_atomically
from storage.cache import cache_folder, open_private, private_folder
from storage.errors import TrilightError
from storage.installation import FILES_ROOT
from storage.machine import available_cores

ROOT = FILES_ROOT
LINK = ROOT / "prefect.toml"
"""Link in the checkout that Prefect's commands read; git ignores it."""


def state_folder() -> Path:
    """Return the folder of logs, password and mark: TRILIGHT_STATE, or one in the cache."""
    place = os.environ.get("TRILIGHT_STATE")
    return private_folder(Path(place).absolute() if place else cache_folder("serve").absolute())


def settings_file() -> Path:
    """Return the file with the URL and the password of the server."""
    return state_folder() / "prefect.toml"


def grant(url: str) -> dict[str, str]:
    """Write the settings file and its link; return the environment of server and clients.

    The password is a new one each time, or that of PREFECT_SERVER_API_AUTH_STRING.

    Raises:
        TrilightError: the checkout holds a prefect.toml of the user, or a file cannot be written.
    """
    if LINK.exists() and not LINK.is_symlink() and not os.environ.get("TRILIGHT_STATE"):
        raise TrilightError(
            f"make serve: {LINK} is a file of your own; expected none, because a link to the "
            "server's password goes there. Move its settings to your profile (prefect config set)."
        )
    password = os.environ.get(PASSWORD) or new_password()
    quoted = [json.dumps(each, ensure_ascii=False) for each in (url, password)]  # as TOML does
    text = "[api]\nurl = {}\nauth_string = {}\n".format(*quoted)
    file = settings_file()
    file.unlink(missing_ok=True)
    with open_private(file, "w") as stream:
        stream.write(text)
    if not os.environ.get("TRILIGHT_STATE"):
        LINK.unlink(missing_ok=True)
        LINK.symlink_to(file)
    return {"PREFECT_API_URL": url, PASSWORD: password, CLIENT_PASSWORD: password}


def revoke() -> None:
    """Delete the settings file and its link."""
    file = settings_file()
    file.unlink(missing_ok=True)
    if LINK.is_symlink() and LINK.readlink() == file:
        with contextlib.suppress(OSError):
            LINK.unlink()


def next_command() -> str:
    """Return the command that starts a flow on the server."""
    command = "prefect deployment run generate-scenes/local --watch"
    if not os.environ.get("TRILIGHT_STATE"):
        return command
    return f"cd {shlex.quote(str(state_folder()))} && {command}"


POOL = "local"
_FLOWS = {
    "PREFECT_LOGGING_EXTRA_LOGGERS": "trilight",
    "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
}
"""Environment variables of a worker for its flows; the form of a flow cannot add to them."""
_MARK = "TRILIGHT_SERVED"
_END_S = 20.0
_RELEASE_S = 5.0


def start(*, host: str, port: int, workers: int) -> str:
    """Start server, pool, workers and deployments; return the URL of the API.

    Args:
        host: host name or IPv4 address to bind to.
        workers: number of workers of the pool; each runs one flow at a time.

    Raises:
        TrilightError: the server runs already, the address is unusable, or a process does not
            start; then the other processes are ended.
    """
    if running():
        raise TrilightError("make serve: the server runs already; run make stop first.")
    if shutil.which("prefect") is None:
        raise TrilightError("make serve: there is no command `prefect`; run make setup.")
    _require_free(host, port)
    shares = [_worker_environment(number, workers) for number in range(workers)]
    quiet_prefect()
    url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/api"
    environment = {**os.environ, **grant(url)}
    environment |= {
        _MARK: uuid.uuid4().hex,
        NAMES: ",".join([host, socket.gethostname(), *os.environ.get(NAMES, "").split(",")]),
        "TRILIGHT_CHECKOUT": str(ROOT),
        "PREFECT_LOGGING_LEVEL": "INFO",
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    }
    write_atomically(_mark_file(), environment[_MARK].encode())
    try:
        _say(f"starting Prefect's server at {url.removesuffix('/api')}; all takes about a minute")
        server = [*SERVER, "--host", host, "--port", str(port)]
        process = _launch("server", server, environment)
        wait_until_healthy(url, process, _log("server"), _say)
        _say(f"making the pool `{POOL}`, its limits and the deployments")
        deploy = ["-m", f"{__package__}.deployments", POOL, "infra/serving/pool.json"]
        if _launch("deployments", [sys.executable, *deploy], environment).wait():
            last = _log("deployments").read_text().strip().rpartition("\n")[2]
            raise TrilightError(f"python {' '.join(deploy)} failed: {last}")
        _say(f"starting {workers} worker{'s' if workers > 1 else ''}")
        for number, share in enumerate(shares):
            name = f"worker-{number}"
            worker = ["worker", "start", "--pool", POOL, "--name", name, "--limit", "1"]
            _launch(name, [str(shutil.which("prefect")), *worker], environment | _FLOWS | share)
    except BaseException:
        stop()
        raise
    return url


def stop() -> int:
    """End all processes of `start` with their flow runs and children; return their number.

    A training gets its signal only from the flow run that started it, so that it saves once.
    """
    ours = running()
    for number in (signal.SIGTERM, signal.SIGKILL):
        pids = running() if number == signal.SIGKILL else running(without=STOPPED_BY_PARENT)
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        deadline = time.monotonic() + _END_S
        while not _all_ended() and time.monotonic() < deadline:
            time.sleep(0.1)
    revoke()
    _mark_file().unlink(missing_ok=True)
    return len(ours)


def _all_ended() -> bool:
    """Return whether two looks see no process: during execve a process shows no environment."""
    for _ in range(2):
        if running():
            return False
        time.sleep(0.05)
    return True


def running(*, without: str | None = None) -> list[int]:
    """Return the ids of the living processes of `start` and their children, by their mark.

    Args:
        without: leave out processes that have this variable in their environment.
    """
    try:
        mark = f"{_MARK}={_mark_file().read_text()}".encode()
    except FileNotFoundError:
        return []
    pids = []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # ended meanwhile, or of another user
            alive = (place / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
            variables = (place / "environ").read_bytes().split(b"\0")
            other = without and any(text.startswith(f"{without}=".encode()) for text in variables)
            if alive and mark in variables and not other:
                pids.append(int(place.name))
    return pids


def _launch(
    name: str, command: Sequence[str], environment: Mapping[str, str]
) -> "subprocess.Popen[bytes]":
    with open_private(_log(name), "ab") as log:
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )


def _require_free(host: str, port: int) -> None:
    """Refuse an address of another machine, or one at which a server listens already."""
    if ":" in host:
        raise TrilightError(
            f"make serve: TRILIGHT_HOST is {host!r}; expected a name or an address of IPv4, such "
            "as 127.0.0.1."
        )
    # a process that ends loses its environment, by which it is known, before its sockets
    deadline = time.monotonic() + _RELEASE_S
    while True:
        try:
            with socket.socket() as probe:
                # as servers do, so that the connections of a server stopped just now do not matter
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind((host, port))
            return
        except OSError as error:
            if time.monotonic() >= deadline:
                raise TrilightError(
                    f"make serve: {host}:{port} cannot be opened ({error.strerror or error}); "
                    "expected an address of this machine and a free port. Set TRILIGHT_PORT to "
                    "another port, or fix TRILIGHT_HOST."
                ) from error
        time.sleep(0.1)


def _worker_environment(number: int, workers: int) -> dict[str, str]:
    """Return the environment variables of a worker's cores and GPUs; empty for a single worker."""
    if workers == 1:
        return {}
    share = {"TRILIGHT_CORES": str(max(1, available_cores() // workers))}
    if cards := visible_gpus():  # with fewer cards than workers, some share one
        share["CUDA_VISIBLE_DEVICES"] = ",".join(cards[number % len(cards) :: workers])
    return share


def _mark_file() -> Path:
    return state_folder() / "mark"


def _log(name: str) -> Path:
    return state_folder() / f"{name}.log"


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201


def main(arguments: list[str]) -> None:
    """Start the server, or with `stop` end it; reads TRILIGHT_HOST, _PORT and _WORKERS."""
    try:
        if arguments == ["stop"]:
            _say(f"ended: {stop()} processes")
            return
        host = os.environ.get("TRILIGHT_HOST", "127.0.0.1")
        port = whole_number("TRILIGHT_PORT", 4200, 65535)
        workers = whole_number("TRILIGHT_WORKERS", 1, 1024)
        url = start(host=host, port=port, workers=workers)
        _say(f"Prefect: {url.removesuffix('/api')}; logs: {state_folder()}")
        # not the password itself, because output gets into recordings and logs
        _say(f"The page asks for a password: it is the auth_string in {settings_file()}")
        _say(f"Next: {next_command()}")
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")


if __name__ == "__main__":
    main(sys.argv[1:])
