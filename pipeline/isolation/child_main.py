"""The child's side: applies limits, answers calls, and dies with its owner."""

import ctypes
import math
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from pipeline.isolation.answers import encode_error, encode_result, receive, send, wait_forever
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.extensions import mistake_in_extension

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent ends, for any reason (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _leave_owner(connection: Connection, output: Connection) -> None:
    """Close all inherited files except the connection to the owner.

    So a child has no terminal. And no child keeps the fork server alive: it ends with the owner,
    for any reason, and its children end with it.
    """
    nothing = os.open(os.devnull, os.O_RDWR)
    needed_files = {1, 2, nothing, connection.fileno()}
    for standard in (1, 2):
        os.dup2(output.fileno(), standard)
    for file in set(map(int, os.listdir("/dev/fd"))) - needed_files:
        os.dup2(
            nothing, file, inheritable=file == 0
        )  # if closed, another file could get its number
    die_with_parent()


_held: Any = None
"""The object that this child holds."""


def hold(factory: Callable[..., object], *args: Any) -> None:
    """Make the object that this child holds."""
    global _held
    _held = factory(*args)


def call_held(method: Callable[..., Any], *args: Any) -> Any:
    """Call a function with the object that this child holds, and further arguments."""
    return method(_held, *args)


def serve(connection: Connection, output: Connection, memory_bytes: int, cpu_s: int | None) -> None:
    """Answer calls until the owner closes the connection; ignores Ctrl-C: the owner decides.

    Args:
        output: receives standard output and standard error.
        cpu_s: most CPU seconds of one call, or None for no limit.
    """
    _leave_owner(connection, output)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    if most != resource.RLIM_INFINITY:  # a limit of the shell, which no process can raise
        memory_bytes = min(memory_bytes, most)
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    file = connection.fileno()
    while True:
        try:
            # pickle: the child trusts its owner; the owner never unpickles a child's bytes
            (message,) = receive(file, wait_forever, sys.maxsize)
            function, args = ForkingPickler.loads(message.data)
        except EOFError:
            os._exit(0)  # the parent has died: skip the destructors of native libraries
        _allow_cpu(cpu_s)
        send(file, _answer(function, args), wait_forever)


def _allow_cpu(seconds: int | None) -> None:
    """Allow more CPU seconds from now on; after them the kernel ends this process in any code."""
    if seconds is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = math.ceil(used.ru_utime + used.ru_stime) + seconds
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def _answer(function: Callable[..., Any], args: tuple[Any, ...]) -> list[bytes | memoryview]:
    try:
        return encode_result(function(*args))
    except Rejected as rejection:
        return encode_error("rejected", rejection.reason, rejection.message)
    except TrilightError as mistake:
        kind = EnvironmentFailure if isinstance(mistake, EnvironmentFailure) else TrilightError
        return encode_error(kind.__name__, str(mistake))
    except MemoryError:
        return encode_error("out_of_memory", "an allocation went over the limit of the child")
    except Exception as error:
        its_author = mistake_in_extension(error)
        if its_author is not None:  # a retry would fail too
            return encode_error("TrilightError", str(its_author))
        lines = traceback.format_exc(limit=-1).strip().splitlines()[1:]  # innermost call, error
        return encode_error("exception", " | ".join(map(str.strip, lines)))
