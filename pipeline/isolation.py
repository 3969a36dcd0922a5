"""Child processes that we own: native code may crash, hang or eat memory there, and costs one item.

A child runs calls one after another, so that slow imports and compiled kernels are paid once. It
has limits on memory and on wall time, is replaced after a number of calls, ignores Ctrl-C (the
parent decides), and dies with its owner even if that is killed with SIGKILL while native code holds
the child: the kernel itself watches the pipe between the two, no thread of Python is needed.
"""

import ctypes
import fcntl
import math
import multiprocessing
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from storage.errors import EnvironmentFailure, Rejected, TrilightError

Result = TypeVar("Result")

_PR_SET_PDEATHSIG = 1
_F_SETSIG = 10  # Linux; Python's fcntl module does not name it
_START_UP_S = 180.0
_LAUNCHES = 3


class ChildFailed(Exception):
    """The child died, hung, or raised something unexpected: the environment's fault, or a bug.

    Attributes:
        reason: `crashed_signal_N`, `killed`, `timeout_wall`, `timeout_cpu`, `out_of_memory` or
            `exception`.
        message: one sentence with what is known.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(f"{reason}: {message}")
        self.reason = reason
        self.message = message


class ChildClosed(Exception):
    """The owner of a child has closed it while somebody was still calling: the run is over."""


@dataclass(frozen=True, kw_only=True)
class ChildLimits:
    """What one child may use."""

    memory_bytes: int
    """Address space; an allocation beyond it fails inside the child."""
    wall_s: float
    """Seconds for one call; a child that takes longer is killed."""
    cpu_s: int | None = None
    """Processor seconds for one call, which a busy machine does not use up; None for no limit."""
    calls_per_child: int
    """A fresh child is started after this many calls, so that leaks stay bounded."""


class IsolatedChild:
    """One child process at a time, started when first needed and replaced when it ends."""

    def __init__(
        self, *, limits: ChildLimits, setup: Callable[..., None], setup_args: tuple[Any, ...] = ()
    ) -> None:
        """Remember how to start a child.

        Args:
            limits: what it may use.
            setup: an importable function that prepares a new child, such as loading a library.
            setup_args: its arguments; they must survive the way into another process.
        """
        self._limits = limits
        self._setup = (setup, setup_args)
        self._process: Any = None
        self._connection: Connection | None = None
        self._calls_left = 0
        self._closed = False

    def call(self, function: Callable[..., Result], *args: Any) -> Result:
        """Run an importable function in the child and return its result.

        Raises:
            Rejected, TrilightError: as the function raised them.
            ChildFailed: the child died, took too long, ran out of memory, or the function raised
                anything else. The next call starts a fresh child.
            TrilightError: also where a new child cannot be set up.
            ChildClosed: `close` was called, perhaps by another thread.
        """
        if self._closed:
            raise ChildClosed
        try:
            if self._connection is None or self._calls_left == 0:
                self._start()
            self._calls_left -= 1
            return self._exchange((function, args), self._limits.wall_s)
        except ChildFailed:
            self._stop()
            raise

    def retire(self) -> None:
        """End the child; the next call starts a fresh one. Not while another thread calls."""
        self._stop()

    def close(self) -> None:
        """End the child at once and for good; safe to call while another thread waits in `call`."""
        self._closed = True
        if self._process is not None:
            self._process.kill()

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            assert self._connection is not None
            self._connection.close()
        self._process = self._connection = None

    def _start(self) -> None:
        self._stop()
        self._process, self._connection = _launched(self._limits)
        self._calls_left = self._limits.calls_per_child
        try:
            self._exchange(self._setup, _START_UP_S)
        except ChildFailed as failure:
            if self._closed:
                raise ChildClosed from failure
            # no item is to blame, and another child would fail as this one did
            raise EnvironmentFailure(
                f"a child process cannot be set up ({failure}); see `trilight doctor`."
            ) from failure

    def _exchange(self, request: tuple[Callable[..., Any], tuple[Any, ...]], wall_s: float) -> Any:
        assert self._connection is not None
        try:
            self._connection.send(request)
            if not self._connection.poll(wall_s):
                raise ChildFailed("timeout_wall", f"no answer within {wall_s:.0f} s")
            kind, *payload = self._connection.recv()
        except (EOFError, OSError) as error:
            raise self._death() from error
        if kind == "result":
            return payload[0]
        if kind == "rejected":
            raise Rejected(*payload)
        if kind == "mistake":
            raise TrilightError(*payload)
        raise ChildFailed(kind, *payload)

    def _death(self) -> ChildFailed:
        self._process.join(10)
        code = self._process.exitcode
        if code is not None and code < 0:
            if -code == signal.SIGXCPU:
                return ChildFailed(
                    "timeout_cpu", f"used its {self._limits.cpu_s} processor seconds"
                )
            if -code == signal.SIGKILL:
                return ChildFailed("killed", "ended by SIGKILL; the system may be out of memory")
            return ChildFailed(
                f"crashed_signal_{-code}", f"native code ended by {signal.Signals(-code).name}"
            )
        return ChildFailed("crashed", f"the child ended with status {code}")


def _launched(limits: ChildLimits) -> tuple[Any, Connection]:
    """Return a new child and the way to it; where the fork server was killed, by a new one.

    Raises:
        EnvironmentFailure: no process can be started.
    """
    context = multiprocessing.get_context("forkserver")
    for tries_left in reversed(range(_LAUNCHES)):
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, limits), daemon=True)
        try:
            process.start()
        except (EOFError, OSError) as error:
            ours.close()
            if not tries_left:
                raise EnvironmentFailure(
                    f"a child process cannot be started ({error}); see `trilight doctor`."
                ) from error
        else:
            return process, ours
        finally:
            theirs.close()
    raise AssertionError("unreachable: the last try returns or raises")


def preload(modules: list[str]) -> None:
    """Import modules once in the fork server, so that every new child has them at once.

    Only for libraries that start no threads when imported. Call before the first child starts.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(modules)


def die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent ends, whatever ends it (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _die_with_owner() -> None:
    """Ask the kernel to kill this child when the process that owns it ends.

    A child's direct parent is the fork server, which lives on while it has children, so that
    `die_with_parent` would wait for ever. What ends with the owner is the sentinel pipe that
    multiprocessing gives every child: its end sends SIGIO, which is turned into SIGKILL here.
    Elsewhere than on Linux a child only notices its owner's end when its call returns.
    """
    if sys.platform != "linux":
        return
    owner = multiprocessing.parent_process()
    assert owner is not None
    sentinel = owner.sentinel
    fcntl.fcntl(sentinel, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(sentinel, _F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(sentinel, fcntl.F_SETFL, fcntl.fcntl(sentinel, fcntl.F_GETFL) | os.O_ASYNC)
    if not owner.is_alive():
        os._exit(1)


def _serve(connection: Connection, limits: ChildLimits) -> None:
    """Answer calls until the parent closes the connection."""
    _die_with_owner()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (limits.memory_bytes, limits.memory_bytes))
    while True:
        try:
            function, args = connection.recv()
        except EOFError:
            os._exit(0)  # the parent is gone: nobody waits for destructors of native libraries
        _allow_cpu(limits.cpu_s)
        connection.send(_answer(function, args))


def _allow_cpu(seconds: int | None) -> None:
    """Let this process use so much more processor time; the kernel ends it then, in any code."""
    if seconds is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = math.ceil(used.ru_utime + used.ru_stime) + seconds
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def _answer(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, ...]:
    try:
        return ("result", function(*args))
    except Rejected as rejection:
        return ("rejected", rejection.reason, rejection.message)
    except TrilightError as mistake:
        return ("mistake", str(mistake))
    except MemoryError:
        return ("out_of_memory", "an allocation went over the limit of the child")
    except Exception:
        return ("exception", _last_error())


def _last_error() -> str:
    """Return the last lines of the current traceback, the innermost call and the error."""
    lines = traceback.format_exc(limit=-1).strip().splitlines()
    return " | ".join(line.strip() for line in lines[1:])


def call_with_retries(
    child: IsolatedChild, function: Callable[..., Result], *args: Any, tries: int = 3
) -> Result:
    """Call in a child, and again in a fresh one where the environment failed, `tries` times.

    Raises:
        ChildFailed: the last failure, after `tries` of them.
    """
    for failures in range(1, tries + 1):
        try:
            return child.call(function, *args)
        except ChildFailed:
            if failures == tries:
                raise
            time.sleep(0.1 * failures)  # what passed by itself, such as a lack of memory, has time
    raise AssertionError("unreachable: tries is at least 1")
