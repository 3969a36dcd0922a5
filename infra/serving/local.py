"""`make serve` and `make stop`: Prefect's server, a pool, a worker and the deployments, here.

Everything binds to loopback, unless TRILIGHT_HOST says otherwise, and answers only who knows the
password of this start (infra.serving.access), by its own name and for its own pages
(pipeline.flows.guarded_server): other users of this machine, its containers and the pages in its
user's browser can reach loopback too.

Prefect knows no roles. Who has the password may do what its API can do, and with deployments and
pools of their own that is whatever the worker's account can do: give it to nobody who may not
have that account. What is held against accidents, stolen forms and careless automation: a run
of our flows is given parameters and nothing else (infra/serving/pool.json and its kin let nobody
choose a command, an image, an environment or a folder to work in), Prefect checks these by the
flow's form, and no parameter names a program. A parameter does name places: `out` may be any folder
that the worker may write, `objects` and `data` any that it may read.

What is started carries a mark in its environment, which flow runs and their children inherit, so
that `stop` ends exactly those, also where a worker was killed, and never a stranger. Several
workers share the cores and the graphics cards evenly. The database is SQLite, or what
PREFECT_API_DATABASE_CONNECTION_URL says.
"""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from infra.serving.access import ROOT, grant, next_command, revoke, settings_file, state_folder
from pipeline.flows.guarded_server import NAMES
from pipeline.flows.prefect_server import (
    SERVER,
    TOLD_BY_ITS_STARTER,
    quiet_prefect,
    wait_until_healthy,
)
from pipeline.making.machine import cores_owned, visible_gpus
from storage.atomic import write_atomically
from storage.cache import open_private
from storage.errors import TrilightError

POOL = "local"
_TEMPLATE = ("--base-job-template", "infra/serving/pool.json")
_FLOWS = {
    "PREFECT_LOGGING_EXTRA_LOGGERS": "trilight",
    "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
}
"""What a worker's environment says to its flows; nobody who starts one can add to it."""
_MARK = "TRILIGHT_SERVED"
_END_S = 20.0
_RELEASE_S = 5.0
_DEFAULT_PORT = 4200
_MOST = {"TRILIGHT_PORT": 65535, "TRILIGHT_WORKERS": 1024}


def start(*, host: str, port: int, workers: int) -> str:
    """Start everything and return the URL of the API.

    Args:
        host: name, or address of IPv4, to bind to.
        port: of the server.
        workers: workers of the pool; each runs one flow at a time.

    Raises:
        TrilightError: it runs already, the address cannot be bound to, or a part does not start;
            then the other parts are ended again.
    """
    if running():
        raise TrilightError("make serve: the server runs already; run make stop first.")
    if shutil.which("prefect") is None:
        raise TrilightError("make serve: there is no command `prefect`; run make setup.")
    _require_free(host, port)
    shares = [_worker_environment(number, workers) for number in range(workers)]
    quiet_prefect()
    url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/api"
    environment = {**os.environ, **grant(url), **_shared_environment(host)}
    try:
        _say(f"starting Prefect's server at {url.removesuffix('/api')}; all takes about a minute")
        server = [*SERVER, "--host", host, "--port", str(port)]
        process = _launch("server", server, environment)
        wait_until_healthy(url, process, _log("server"))
        _prepare(environment)
        _say(f"starting {workers} worker{'s' if workers > 1 else ''}")
        for number, share in enumerate(shares):
            name = f"worker-{number}"
            worker = ["worker", "start", "--pool", POOL, "--name", name, "--limit", "1"]
            _launch(name, [str(shutil.which("prefect")), *worker], environment | _FLOWS | share)
    except BaseException:
        stop()
        raise
    return url


def _shared_environment(host: str) -> dict[str, str]:
    """Return what all parts are told of where they are, and the mark by which they are known."""
    mark = uuid.uuid4().hex
    write_atomically(_mark_file(), mark.encode())
    names = [host, socket.gethostname(), *os.environ.get(NAMES, "").split(",")]
    return {
        _MARK: mark,
        NAMES: ",".join(names),
        "TRILIGHT_CHECKOUT": str(ROOT),
        "PREFECT_LOGGING_LEVEL": "INFO",
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    }


def stop() -> int:
    """End what `start` started, with every flow run and child of theirs; return how many it was.

    Training is told to save by the flow run that started it, and by nobody else.
    """
    ours = running()
    for number in (signal.SIGTERM, signal.SIGKILL):
        pids = running() if number == signal.SIGKILL else running(without=TOLD_BY_ITS_STARTER)
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
    """Look twice: while a process becomes another program (execve), it shows no environment."""
    for _ in range(2):
        if running():
            return False
        time.sleep(0.05)
    return True


def running(*, without: str | None = None) -> list[int]:
    """Return the living processes that `start` started, and theirs, by the mark that they carry.

    Args:
        without: leave out those that have this variable in their environment.
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


def _prepare(environment: Mapping[str, str]) -> None:
    """Make pool, limits and deployments; what is there already is replaced."""
    prefect = [str(shutil.which("prefect")), "--no-prompt"]
    pool = ["work-pool", "create", POOL, "--type", "process", "--overwrite", *_TEMPLATE]
    limits = [sys.executable, "-m", f"{__package__}.limits"]
    deployments = ["deploy", "--name", f"*/{POOL}"]
    steps = {
        f"the pool `{POOL}`": [*prefect, *pool],
        "its limits": limits,
        "the deployments": [*prefect, *deployments],
    }
    for what, command in steps.items():
        _say(f"making {what}")
        _call(command, environment)


def _call(command: Sequence[str], environment: Mapping[str, str]) -> None:
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise TrilightError(f"{' '.join(command)} failed: {' '.join(last)}")


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


def _refusal(host: str, port: int) -> str | None:
    """Return why nobody can listen there, or None."""
    try:
        with socket.socket() as probe:
            # as servers do: connections of one that was stopped just now are no obstacle
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        return error.strerror or str(error)
    return None


def _require_free(host: str, port: int) -> None:
    """Refuse an address that is none of ours, or where somebody listens, be it another Prefect."""
    if ":" in host:
        raise TrilightError(
            f"make serve: TRILIGHT_HOST is {host!r}; expected a name or an address of IPv4, such "
            "as 127.0.0.1."
        )
    # a process that ends loses its environment, by which it is known, before its sockets
    deadline = time.monotonic() + _RELEASE_S
    while (refused := _refusal(host, port)) and time.monotonic() < deadline:
        time.sleep(0.1)
    if refused:
        raise TrilightError(
            f"make serve: {host}:{port} cannot be opened ({refused}); expected an address "
            "of this machine and a free port. Set TRILIGHT_PORT to another port, "
            "or mend TRILIGHT_HOST."
        )


def _worker_environment(number: int, workers: int) -> dict[str, str]:
    """Return what a worker's environment says of its part of the machine; alone, it has all."""
    if workers == 1:
        return {}
    share = {"TRILIGHT_CORES": str(max(1, cores_owned() // workers))}
    if cards := visible_gpus():  # with fewer cards than workers, some share one
        share["CUDA_VISIBLE_DEVICES"] = ",".join(cards[number % len(cards) :: workers])
    return share


def _mark_file() -> Path:
    return state_folder() / "mark"


def _log(name: str) -> Path:
    return state_folder() / f"{name}.log"


def _say(text: str) -> None:
    print(text, flush=True)  # noqa: T201


def _number(variable: str, default: int) -> int:
    text = os.environ.get(variable, str(default))
    most = _MOST[variable]
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= most:
        raise TrilightError(
            f"make serve: {variable} is {text!r}; expected a whole number from 1 to {most}."
        )
    return int(text)


def main(arguments: list[str]) -> None:
    """Start or stop, as the only argument says; TRILIGHT_HOST, _PORT and _WORKERS say how."""
    try:
        if arguments == ["stop"]:
            _say(f"ended: {stop()} processes")
            return
        host = os.environ.get("TRILIGHT_HOST", "127.0.0.1")
        port = _number("TRILIGHT_PORT", _DEFAULT_PORT)
        workers = _number("TRILIGHT_WORKERS", 1)
        url = start(host=host, port=port, workers=workers)
        _say(f"Prefect: {url.removesuffix('/api')}; logs: {state_folder()}")
        # not the password itself: what is on a screen gets into recordings and logs of others
        _say(f"The page asks for a password: it is the auth_string in {settings_file()}")
        _say(f"Next: {next_command()}")
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")


if __name__ == "__main__":
    main(sys.argv[1:])
