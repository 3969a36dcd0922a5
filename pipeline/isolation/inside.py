"""What happens inside a child: it keeps its limits, answers calls, and dies with its owner."""

import ctypes
import fcntl
import math
import multiprocessing
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from pipeline.isolation.answers import encode_error, encode_result
from pipeline.isolation.frames import receive, send, wait_forever
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.extensions import mistake_in_extension

_PR_SET_PDEATHSIG = 1
_F_SETSIG = 10  # Linux; Python's fcntl module does not name it


def die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent ends, whatever ends it (Linux only)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _die_with_owner() -> None:
    """Ask the kernel to kill this child when the process that owns it ends.

    A child's direct parent is the fork server, which lives on while it has children, so that
    `die_with_parent` would wait forever. What ends with the owner is the sentinel pipe that
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


def serve(connection: Connection, memory_bytes: int, cpu_s: int | None) -> None:
    """Answer calls until the owner closes the connection; ignores Ctrl-C: the owner decides.

    Args:
        connection: to the owner.
        memory_bytes: most address space.
        cpu_s: most processor seconds of one call, or None for no limit.
    """
    _die_with_owner()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = resource.getrlimit(resource.RLIMIT_AS)[1]
    if most != resource.RLIM_INFINITY:  # of this shell, which no process can raise
        memory_bytes = min(memory_bytes, most)
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    file = connection.fileno()
    while True:
        try:
            # our owner's own words, which are trusted; of ours it trusts none
            function, args = ForkingPickler.loads(receive(file, wait_forever, sys.maxsize))
        except EOFError:
            os._exit(0)  # the parent has died: skip the destructors of native libraries
        _allow_cpu(cpu_s)
        send(file, _answer(function, args), wait_forever)


def _allow_cpu(seconds: int | None) -> None:
    """Let this process use so much more processor time; the kernel ends it then, in any code."""
    if seconds is None:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    soft = math.ceil(used.ru_utime + used.ru_stime) + seconds
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def _answer(function: Callable[..., Any], args: tuple[Any, ...]) -> list[bytes | memoryview]:
    try:
        return encode_result(function(*args), function)
    except Rejected as rejection:
        return encode_error("rejected", rejection.reason, rejection.message)
    except EnvironmentFailure as failure:
        return encode_error("EnvironmentFailure", str(failure))
    except TrilightError as mistake:
        return encode_error("TrilightError", str(mistake))
    except MemoryError:
        return encode_error("out_of_memory", "an allocation went over the limit of the child")
    except Exception as error:
        its_author = mistake_in_extension(error)
        if its_author is not None:  # tried again, it stays
            return encode_error("TrilightError", str(its_author))
        return encode_error("exception", _last_error())


def _last_error() -> str:
    """Return the last lines of the current traceback, the innermost call and the error."""
    lines = traceback.format_exc(limit=-1).strip().splitlines()
    return " | ".join(line.strip() for line in lines[1:])
