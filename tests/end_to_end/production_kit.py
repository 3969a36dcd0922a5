"""The documented production path, private to a test, and pages that a command serves."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from tests.command_line import run_program
from tests.conftest import ROOT

SERVERS = (ROOT / "docs/how-to/servers-and-clusters.md").read_text()
FEW_SAMPLES_CHANGES = {"scenes": {"num_views": 1}, "renders": {"min_spp": 16, "max_spp": 16}}
"""Of scenes whose light nobody looks at: 16 of them take 8 processor seconds, and not 25."""
SIXTEEN_SAMPLES = ("--set", "renders.min_spp=16", "--set", "renders.max_spp=16")
FEW_SAMPLES = (*SIXTEEN_SAMPLES, "--set", "scenes.num_views=1")
START, STOP = (["-m", "infra.serving.local", action] for action in ("start", "stop"))
"""What `make serve` and `make stop` run, as arguments of Python."""
START_S = 300
"""A server that makes its database on two busy cores took 137 s."""


_PORTS = iter(range(20_000 + 211 * os.getpid() % 10_000, 32_000))
"""Far from those of other workers, whose processes have numbers close to this one's."""


def free_port() -> int:
    """Return a port that nobody listens at, another one each time.

    It lies below those that the kernel lends to clients: one that tries to reach a server which is
    down may be lent that server's own port, and the server cannot start.
    """
    for port in _PORTS:
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free below 32,000")


class Postgres:
    """A PostgreSQL of the distribution's packages in a folder of its own; it refuses to be root."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        self._user = "postgres" if os.geteuid() == 0 else None
        if self._user:
            shutil.chown(folder, self._user)
        self._where = ("--host", "127.0.0.1", "--port", str(self.port), "--username", "me")
        self._run("initdb", "--pgdata", str(folder / "db"), "--auth", "trust", "--username", "me")
        self.start()
        self._run("createdb", *self._where, "prefect")

    @property
    def url(self) -> str:
        return f"postgresql+asyncpg://me@127.0.0.1:{self.port}/prefect"

    def start(self) -> None:
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories="
        log = str(self.folder / "log")
        self._control("start", "--wait", "--log", log, "--options", options)

    def stop(self) -> None:
        self._control("stop", "--mode", "immediate")

    def _control(self, *arguments: str) -> None:
        self._run("pg_ctl", *arguments, "--pgdata", str(self.folder / "db"))

    def dump(self) -> str:
        """Return every row of every table of Prefect's, as SQL."""
        done = subprocess.run(
            [_tools("pg_dump")[0], *self._where, "--data-only", "prefect"],
            check=True, timeout=START_S, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        )  # fmt: skip
        return done.stdout

    def _run(self, *arguments: str) -> None:
        tool = next(iter(_tools(arguments[0])), arguments[0])
        subprocess.run(
            [tool, *arguments[1:]], user=self._user, cwd="/", check=True, timeout=START_S,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip


def _tools(name: str) -> list[str]:
    found = shutil.which(name)
    return [found] if found else [str(p) for p in Path("/usr/lib/postgresql").glob(f"*/bin/{name}")]


@contextlib.contextmanager
def postgres() -> Iterator[Postgres]:
    """A running PostgreSQL; skips where the packages are not installed."""
    if not _tools("initdb"):
        pytest.skip("PostgreSQL is not installed: apt-get install postgresql")
    with tempfile.TemporaryDirectory(prefix="trilight-pg-") as folder:
        Path(folder).chmod(0o755)
        database = Postgres(Path(folder))
        try:
            yield database
        finally:
            database.stop()


def documented_serving() -> list[str]:
    """Return the lines with which the documents show how flows are served and run."""
    (block,) = re.findall(r"```sh\n(make serve\n.*?)```", SERVERS, re.DOTALL)
    return str(block).splitlines()


def documented_run(flow: str = "", **replaced: object) -> list[str]:
    """Return the documents' command that runs a flow, as arguments of Python.

    Args:
        flow: another flow, of those that the page names below.
        replaced: values of its parameters that a test has smaller, or elsewhere; others are added.
    """
    _, line, _, _ = documented_serving()
    command, *words = shlex.split(line)
    assert command == "prefect"
    places = [at for at, word in enumerate(words) if word == "-p"]
    names = {words[at + 1].partition("=")[0] for at in places}
    kept = [word for at, word in enumerate(words) if at not in places and at - 1 not in places]
    if flow:
        assert f"`{flow}`" in SERVERS
        kept = [word.replace("generate-scenes", flow) for word in kept]
    else:
        assert names <= set(replaced), "the page's sizes and folders are not a test's"
    given = [word for name, value in replaced.items() for word in ("-p", f"{name}={value}")]
    return ["-m", "prefect", *kept, *given]


@contextlib.contextmanager
def served(
    tmp_path: Path, database_url: str, workers: int, base: Mapping[str, str] = os.environ
) -> Iterator[dict[str, str]]:
    """What `make serve` starts, with state and port of its own; gives a client's environment.

    The password is a new one at each start, which `start_served` puts into the environment.
    """
    port = str(free_port())
    environment = {
        **base,
        "TRILIGHT_STATE": str(tmp_path / "state"),
        "TRILIGHT_PORT": port,
        "TRILIGHT_WORKERS": str(workers),
        "PREFECT_HOME": str(tmp_path / "prefect"),
        "PREFECT_API_URL": f"http://127.0.0.1:{port}/api",
        "PREFECT_API_DATABASE_CONNECTION_URL": database_url,
        "PATH": f"{Path(sys.executable).parent}:{base['PATH']}",
        "PYTHONPATH": str(ROOT),
        # only their forms on the page need them
        "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": "false",
        "PREFECT_SERVER_MEMOIZE_BLOCK_AUTO_REGISTRATION": "false",
    }
    try:
        start_served(environment)
        yield environment
    finally:
        stop_served(environment)


def copy_of_the_project(folder: Path) -> None:
    """Copy what git tracks, and lend the environment: set-up is proved elsewhere (study S64)."""
    for name in filter(None, run_program(["git", "ls-files", "-z"]).stdout.split("\0")):
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)
    (folder / ".venv").symlink_to(ROOT / ".venv")


def start_served(environment: dict[str, str]) -> None:
    """Run what `make serve` runs, and let clients know the password."""
    call(START, environment, timeout=2 * START_S)
    settings = tomllib.loads((Path(environment["TRILIGHT_STATE"]) / "prefect.toml").read_text())
    environment["PREFECT_API_AUTH_STRING"] = settings["api"]["auth_string"]


def stop_served(environment: Mapping[str, str]) -> None:
    """Run what `make stop` runs."""
    call(STOP, environment, timeout=120)


def call(
    arguments: list[str], environment: Mapping[str, str], timeout: float, folder: Path = ROOT
) -> str:
    """Run Python in a checkout and return what it says; a failure shows all of it."""
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, text=True, timeout=timeout,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@contextlib.contextmanager
def dask_cluster(folder: Path, workers: int) -> Iterator[str]:
    """A scheduler and worker processes of one thread each; gives the address."""
    pytest.importorskip("prefect_dask", reason="make setup-all brings prefect-dask")
    distributed = pytest.importorskip("distributed")
    address = f"tcp://127.0.0.1:{free_port()}"
    run = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1"]
    run += ["--no-nanny", "--no-dashboard", "--local-directory", str(folder)]
    port = address.rpartition(":")[2]
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    commands = [[*scheduler, "--host", "127.0.0.1", "--port", port], *([run] * workers)]
    environment = {**os.environ, "TRILIGHT_CORES": "1", "PYTHONPATH": str(ROOT)}
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for command in commands:
            log = (folder / f"dask-{len(processes)}.log").open("wb")
            processes.append(
                subprocess.Popen(command, env=environment, cwd=ROOT, stdout=log, stderr=log)
            )
        deadline = time.monotonic() + START_S
        is_up = False
        while not is_up:
            assert time.monotonic() < deadline, "the Dask cluster did not start"
            with (
                contextlib.suppress(OSError),
                distributed.Client(address, timeout=20, set_as_default=False) as client,
            ):
                client.wait_for_workers(workers, timeout=START_S)
                is_up = True
        yield address
    finally:
        for process in processes:
            process.kill()
            process.wait()


_END_S = 600
"""The end waits for the step at hand: 13 s on two busy cores, and over a minute on busier ones."""


@contextlib.contextmanager
def viewed(command: Sequence[str], folder: Path) -> Iterator[str]:
    """Yield the address of a page that a command serves; it has to end cleanly at Ctrl-C."""
    run = subprocess.Popen(
        [*command, "--no-browser"], cwd=folder,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip
    assert run.stdout is not None
    try:
        assert run.stdout.readline().startswith("Opening")
        while not (found := re.search(r"http://\S+", line := run.stdout.readline())):
            assert line, "it has ended before it said an address"
        yield found[0]
        with contextlib.suppress(urllib.error.HTTPError):
            answer_of(found[0], "api/none")  # comes once the source is open: Ctrl-C is waited for
        run.send_signal(signal.SIGINT)
        out, errors = run.communicate(timeout=_END_S)
        assert (run.returncode, errors) == (0, ""), errors
        assert out.rstrip().endswith("Ended.")
    finally:
        run.kill()
        run.wait()


def answer_of(address: str, path: str) -> bytes:
    """Return what a page is told, as its script asks for it."""
    with urllib.request.urlopen(address + path, timeout=120) as answer:
        data: bytes = answer.read()
    return data
