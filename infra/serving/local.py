"""`make serve` and `make stop`: Prefect's server, a pool, a worker and the deployments, here.

Everything binds to loopback and needs a password as soon as it does not. What is started carries a
mark in its environment, which flow runs and their children inherit, so that `stop` ends exactly
those, also where a worker was killed, and never a stranger. Several workers share the cores and the
graphics cards evenly. The database is SQLite, or what PREFECT_API_DATABASE_CONNECTION_URL says.
"""

import contextlib
import ipaddress
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping
from pathlib import Path

from infra.serving.limits import ROOT, call_prefect, make_limits
from pipeline.flows.machine import cores_owned, visible_gpus
from pipeline.flows.prefect_server import (
    TOLD_BY_ITS_STARTER,
    quiet_prefect,
    wait_until_healthy,
)
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.errors import TrilightError

POOL = "local"
_MARK = "TRILIGHT_SERVED"
_END_S = 20.0
_RELEASE_S = 5.0
_DEFAULT_PORT = 4200
_MOST = {"TRILIGHT_PORT": 65535, "TRILIGHT_WORKERS": 1024}


def start(*, host: str, port: int, workers: int) -> str:
    """Start everything and return the URL of the API.

    Args:
        host: name, or address of IPv4, to bind to; anything but loopback needs
            PREFECT_SERVER_API_AUTH_STRING.
        port: of the server.
        workers: workers of the pool; each runs one flow at a time.

    Raises:
        TrilightError: it runs already, the address is open without a password, or cannot be bound
            to, or a part does not start; then the other parts are ended again.
    """
    if running():
        raise TrilightError("make serve: it runs already; expected nothing. Try make stop first.")
    _require_password(host)
    if shutil.which("prefect") is None:
        raise TrilightError("make serve: there is no command `prefect`; run make setup.")
    _require_free(host, port)
    shares = [_share(number, workers) for number in range(workers)]
    quiet_prefect()
    url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}/api"
    write_atomically(_mark_file(), (mark := uuid.uuid4().hex).encode())
    environment = {
        **os.environ,
        _MARK: mark,
        "PREFECT_API_URL": url,
        "TRILIGHT_CHECKOUT": str(ROOT),
        "TRILIGHT_IMAGE": os.environ.get("TRILIGHT_IMAGE", "trilight:latest"),
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
        "PREFECT_LOGGING_LEVEL": "INFO",
    }
    if password := os.environ.get("PREFECT_SERVER_API_AUTH_STRING"):
        environment.setdefault("PREFECT_API_AUTH_STRING", password)
    try:
        server = ["server", "start", "--host", host, "--port", str(port)]
        process = _launch("server", server, environment)
        wait_until_healthy(url, process, _log("server"))
        _prepare(environment)
        for number, share in enumerate(shares):
            name = f"worker-{number}"
            worker = ["worker", "start", "--pool", POOL, "--name", name, "--limit", "1"]
            _launch(name, worker, environment | share)
    except BaseException:
        stop()
        raise
    return url


def stop() -> int:
    """End what `start` started, with every flow run and child of theirs; return how many it was.

    Training is told to save by the flow run that started it, and by nobody else.
    """
    ours = running()
    for number in (signal.SIGTERM, signal.SIGKILL):
        told = running() if number == signal.SIGKILL else running(without=TOLD_BY_ITS_STARTER)
        for pid in told:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
        deadline = time.monotonic() + _END_S
        while not _all_ended() and time.monotonic() < deadline:
            time.sleep(0.1)
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
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # ended meanwhile, or of another user
            alive = (place / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
            variables = (place / "environ").read_bytes().split(b"\0")
            other = without and any(text.startswith(f"{without}=".encode()) for text in variables)
            if alive and mark in variables and not other:
                found.append(int(place.name))
    return found


def _prepare(environment: Mapping[str, str]) -> None:
    """Make pool, limits and deployments; what is there already is replaced."""
    for arguments in (
        ["work-pool", "create", POOL, "--type", "process", "--overwrite"],
        ["deploy", "--name", f"*/{POOL}"],
    ):
        call_prefect(arguments, environment)
    make_limits(environment)


def _launch(
    name: str, arguments: list[str], environment: Mapping[str, str]
) -> "subprocess.Popen[bytes]":
    with _log(name).open("ab") as log:
        return subprocess.Popen(
            [str(shutil.which("prefect")), *arguments],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )


def _require_password(host: str) -> None:
    loopback = host == "localhost"
    try:
        loopback = loopback or ipaddress.ip_address(host).is_loopback
    except ValueError:
        pass
    if not loopback and not os.environ.get("PREFECT_SERVER_API_AUTH_STRING"):
        raise TrilightError(
            f"make serve: {host} can be reached from other machines; expected a password. Set "
            "PREFECT_SERVER_API_AUTH_STRING to USER:PASSWORD, and PREFECT_API_AUTH_STRING to the "
            "same where flows are started."
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
            f"make serve: {host}:{port} cannot be had ({refused}); expected an address of "
            "this machine and a port at which nobody listens. Set TRILIGHT_PORT to another port, "
            "or mend TRILIGHT_HOST."
        )


def _share(number: int, workers: int) -> dict[str, str]:
    """Return what a worker's environment says of its part of the machine; alone, it has all."""
    if workers == 1:
        return {}
    share = {"TRILIGHT_CORES": str(max(1, cores_owned() // workers))}
    if cards := visible_gpus():  # with fewer cards than workers, some share one
        share["CUDA_VISIBLE_DEVICES"] = ",".join(cards[number % len(cards) :: workers])
    return share


def state_folder() -> Path:
    """Return where logs and the list of processes are: TRILIGHT_STATE, or in the cache."""
    place = os.environ.get("TRILIGHT_STATE")
    return Path(place) if place else cache_folder("serve")


def _mark_file() -> Path:
    return state_folder() / "mark"


def _log(name: str) -> Path:
    return state_folder() / f"{name}.log"


def next_command(url: str) -> str:
    """Return what starts a flow at the API of a URL; pyproject.toml names the default one."""
    command = "prefect deployment run generate-scenes/local --watch"
    known = url == f"http://127.0.0.1:{_DEFAULT_PORT}/api"
    return command if known else f"PREFECT_API_URL={url} {command}"


def _number(variable: str, default: int) -> int:
    text, most = os.environ.get(variable, str(default)), _MOST[variable]
    if not (text.isascii() and text.isdecimal()) or not 1 <= int(text) <= most:
        raise TrilightError(
            f"make serve: {variable} is {text!r}; expected a whole number from 1 to {most}."
        )
    return int(text)


def main(arguments: list[str]) -> None:
    """Start or stop, as the only argument says; TRILIGHT_HOST, _PORT and _WORKERS say how."""
    try:
        if arguments == ["stop"]:
            print(f"ended: {stop()} processes")  # noqa: T201
            return
        host = os.environ.get("TRILIGHT_HOST", "127.0.0.1")
        port, workers = _number("TRILIGHT_PORT", _DEFAULT_PORT), _number("TRILIGHT_WORKERS", 1)
        url = start(host=host, port=port, workers=workers)
        print(f"Prefect: {url.removesuffix('/api')}; logs: {state_folder()}")  # noqa: T201
        print(f"Next: {next_command(url)}")  # noqa: T201
    except TrilightError as mistake:
        sys.exit(f"trilight: {mistake}")


if __name__ == "__main__":
    main(sys.argv[1:])
