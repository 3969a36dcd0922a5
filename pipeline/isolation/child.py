"""`IsolatedChild`: starts, calls and ends a child process, which answers by `serve`.

A child runs calls one after another, so that slow imports and compiled kernels are paid once. It
has limits on memory and wall time, is replaced after a number of calls, ignores Ctrl-C (the owner
decides), and dies with its owner even if that is killed with SIGKILL while native code runs in the
child: the kernel ends it with its parent, the fork server, which ends with the owner.
"""

import contextlib
import ctypes
import math
import multiprocessing
import os
import queue
import resource
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import ModuleType
from typing import Any

from pipeline.isolation.answers import (
    CallTime,
    decode_answer,
    encode_error,
    encode_result,
    receive,
    send,
)
from pipeline.isolation.call_failures import ChildFailed, Result, with_retries
from pipeline.isolation.confinement import (
    NO_FILES,
    Reach,
    confine,
    covers,
    merge_folders,
    should_confine,
)
from storage.errors import EnvironmentFailure, Rejected, TrilightError
from storage.extensions import load_same, loaded_files, mistake_in_extension
from storage.installation import child_environment, order_installed_first
from storage.remote.url import escape_lines

_START_UP_S = 180.0
_LAUNCHES = 3
_MOST_BYTES = 16 << 30
"""Most bytes of one answer; a child's memory limit also bounds it."""
_LONGEST_FOLDER = 70
"""Most bytes of the temporary folder: the fork server's socket path there is limited to 107."""
_CRASHES = (signal.SIGABRT, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV, signal.SIGTRAP)
"""Signals by which native code ends itself. All others come from outside, SIGBUS too: an unreadable
file or a full disk behind a memory map."""
_one_start = threading.Lock()
"""Held while a child starts, since `__main__` is hidden meanwhile."""


class ChildClosed(Exception):
    """The owner of a child closed it during a call: the run is over."""


@dataclass(frozen=True, kw_only=True)
class ChildLimits:
    """Resource limits of one child."""

    memory_bytes: int
    """Address space; an allocation beyond it fails inside the child."""
    wall_s: float
    """Seconds for one call; a child that takes longer is killed."""
    cpu_s: int | None = None
    """CPU seconds for one call, independent of other load on the machine; None for no limit."""
    calls_per_child: int
    """A fresh child is started after this many calls, so that leaks stay bounded."""


class IsolatedChild:
    """One child process at a time, started when first needed and replaced when it ends."""

    def __init__(
        self,
        *,
        limits: ChildLimits,
        factory: Callable[..., object] | None = None,
        args: tuple[Any, ...] = (),
        confined_to: Reach | None = None,
        writes: Iterable[Path] = (),
    ) -> None:
        """Configure the child; the first call starts it.

        Args:
            factory: an importable class or function that makes the object which a new child
                holds, for `call_method`; it may also load a library.
            args: picklable arguments of `factory`.
            confined_to: files that the child may read beside libraries, if the machine can confine
                children; `allow_files` adds to them. None for an unconfined child.
            writes: existing folders in which a confined child may also read and write.

        Raises:
            TrilightError: TRILIGHT_CONFINE has an unknown value, or requires a missing feature.
        """
        self._limits = limits
        self._factory = factory
        self._args = args
        self._process: Any = None
        self._connection: Connection | None = None
        self._calls_left = 0
        self._closed = False
        self._writes = frozenset(Path(path).resolve() for path in writes)
        self._reach: Reach | None = None
        if confined_to is not None and should_confine():
            self._reach = confined_to | self._writes

    def allow_files(self, more: Reach) -> None:
        """Extend the files that a confined child may read; not while another thread calls.

        A running child without that access is replaced: the kernel cannot loosen a confinement.
        """
        if self._reach is not None and not covers(self._reach, more):
            self._reach = merge_folders(self._reach | more)
            self.retire()

    def call(self, function: Callable[..., Result], *args: Any, of_held: bool = False) -> Result:
        """Run an importable function in the child and return its result.

        With `of_held` its first argument is the object that the child holds.

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
            if self._calls_left == 0:
                try:
                    with_retries(self._launch_and_set_up)
                except ChildFailed as failure:
                    raise _cannot_be_set_up(failure) from failure
            self._calls_left -= 1
            return self._exchange(function, args, self._limits.wall_s, of_held=of_held)
        except ChildFailed:
            self.retire()
            raise

    def call_method(self, method: Callable[..., Result], *args: Any) -> Result:
        """Run a function of the object that the child holds; as `call`."""
        return self.call(method, *args, of_held=True)

    def close(self) -> None:
        """End the child at once and permanently; safe while another thread waits in `call`."""
        self._closed = True
        if self._process is not None:
            self._process.kill()

    def retire(self) -> None:
        """End the child; the next call starts a fresh one. Not while another thread calls."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            assert self._connection is not None
            self._connection.close()
        self._process = self._connection = None
        self._calls_left = 0

    def _launch_and_set_up(self) -> None:
        self.retire()
        self._process, self._connection = _launch(self._limits)
        try:
            files = loaded_files()
            if self._reach is not None:  # before it starts threads
                extensions = {Path(path).parent for path, _ in files}
                self._exchange(confine, (self._reach | extensions, self._writes), _START_UP_S)
            if files:  # first: the factory may use their definitions
                self._exchange(load_same, (files,), _START_UP_S)
            if self._factory is not None:
                self._exchange(hold, (self._factory, *self._args), _START_UP_S)
        except ChildFailed as failure:
            if self._closed:
                raise ChildClosed from failure
            if failure.reason == "exception":  # the factory failed: no item is to blame
                raise _cannot_be_set_up(failure) from failure
            raise
        self._calls_left = self._limits.calls_per_child

    def _exchange(
        self,
        function: Callable[..., Result],
        args: tuple[Any, ...],
        wall_s: float,
        *,
        of_held: bool = False,
    ) -> Result:
        """Send a call, and return the result, checked by the type that the function declares.

        With `of_held` the object that the child holds comes before `args`.
        """
        from pipeline.isolation.result_schema import result_reader  # children do without

        assert self._connection is not None
        result_reader(function)  # raises first if the declared result type cannot be checked
        file = self._connection.fileno()
        wait = CallTime(self._process.pid, wall_s)
        try:
            send(file, [ForkingPickler.dumps((function, args, of_held))], wait)
            answer = receive(file, min(self._limits.memory_bytes, _MOST_BYTES), wait)
            result: Result = decode_answer(answer, function)
            return result
        except MemoryError as error:
            raise ChildFailed("out_of_memory", "this process has no memory for the call") from error
        except (EOFError, OSError) as error:
            raise self._death() from error

    def _death(self) -> ChildFailed:
        self._process.join(10)
        code = self._process.exitcode
        if code is None or code >= 0:
            return ChildFailed("crashed", f"the child ended with status {code}")
        if -code == signal.SIGXCPU and self._limits.cpu_s is not None:
            return ChildFailed("timeout_cpu", f"used its {self._limits.cpu_s} processor seconds")
        name = signal.Signals(-code).name
        if -code in _CRASHES:
            return ChildFailed(f"crashed_signal_{-code}", f"native code ended by {name}")
        hint = "; the system may be out of memory" if -code == signal.SIGKILL else ""
        return ChildFailed("killed", f"ended by {name}{hint}")


def _cannot_be_set_up(failure: ChildFailed) -> EnvironmentFailure:
    return EnvironmentFailure(
        f"a child process cannot be set up ({failure}); see `trilight doctor`."
    )


def _launch(limits: ChildLimits, tries: int = _LAUNCHES) -> tuple[Any, Connection]:
    """Start a child; return it and the connection to it. A killed fork server is replaced.

    Raises:
        EnvironmentFailure: no process can be started.
    """
    context = multiprocessing.get_context("forkserver")
    ours, theirs = context.Pipe()
    output, output_sink = context.Pipe(duplex=False)
    words = (theirs, output_sink, limits.memory_bytes, limits.cpu_s)
    process = context.Process(target=serve, args=words, daemon=True)
    try:
        with theirs, output_sink, _apart_from_program():
            process.start()
    except (EOFError, OSError) as error:
        ours.close()
        output.close()
        if tries > 1:
            return _launch(limits, tries - 1)
        raise EnvironmentFailure(
            f"a child process cannot be started ({error}); see `trilight doctor`."
        ) from error
    os.set_blocking(ours.fileno(), False)
    threading.Thread(target=_print_output, args=(output,), daemon=True).start()
    return process, ours


def _print_output(output: Connection) -> None:
    """Copy a child's output to standard error, with control characters escaped."""
    with output, contextlib.suppress(OSError):
        while words := os.read(output.fileno(), 1 << 14):
            os.write(2, escape_lines(words.decode(errors="replace")).encode())


@contextlib.contextmanager
def _apart_from_program() -> Iterator[None]:
    """Keep the program and modules of the working folder out of a child, and of its servers.

    A program that runs from a file is hidden: multiprocessing would run it again in the child.
    Children import the functions that they call by name, and do not need the program. A user's
    program without `if __name__ == "__main__"` would start children there. A program run by
    `python -m` is a module, whose functions a child may import.

    A file of the working folder that is named like one of Python's modules would be run before the
    child is confined. The socket of the fork server is below /tmp if TMPDIR is too long for one.
    """
    with _one_start:
        program = sys.modules["__main__"]
        environment = os.environ.copy()
        paths = sys.path
        temporary = tempfile.tempdir
        try:
            if program.__spec__ is None:
                sys.modules["__main__"] = ModuleType("__main__")
            os.environ.update(child_environment())
            sys.path = order_installed_first(paths)
            if len(os.fsencode(tempfile.gettempdir())) > _LONGEST_FOLDER:
                tempfile.tempdir = "/tmp"
            yield
        finally:
            sys.modules["__main__"] = program
            sys.path = paths
            tempfile.tempdir = temporary
            for name in ("PYTHONSAFEPATH", "PYTHONPATH"):
                if name in environment:
                    os.environ[name] = environment[name]
                else:
                    os.environ.pop(name, None)


def preload(modules: list[str]) -> None:
    """Import modules once in the fork server, so that every new child has them loaded.

    Only for libraries that start no threads when imported. Call before the first child starts.
    """
    multiprocessing.get_context("forkserver").set_forkserver_preload(modules)


def call_with_retries(child: IsolatedChild, function: Callable[..., Result], *args: Any) -> Result:
    """Call a function in a child; after a failure retry in a fresh one, by `call_failures.ENDS`.

    Raises:
        ChildFailed: the last failure; `is_verdict` is True if the call itself is to blame.
    """
    return with_retries(lambda: child.call(function, *args))


class ChildPool:
    """At most `size` children, each with its compiled kernels warm for the next task."""

    def __init__(self, make_child: Callable[[int], IsolatedChild], size: int) -> None:
        """Make the children; each starts its process when it is first called.

        Args:
            make_child: called with the number of each child, from 0.
            size: number of children.
        """
        self._children = [make_child(number) for number in range(size)]
        self._free: queue.SimpleQueue[IsolatedChild] = queue.SimpleQueue()
        for child in self._children:
            self._free.put(child)

    @contextlib.contextmanager
    def borrow(self, files: Reach = NO_FILES) -> Iterator[IsolatedChild]:
        """Lend a free child that may read some files, too; wait while all are lent."""
        child = self._free.get()
        try:
            if files:
                child.allow_files(files)
            yield child
        finally:
            self._free.put(child)

    def close(self) -> None:
        """End all children at once."""
        for child in self._children:
            child.close()


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
            (message,) = receive(file, sys.maxsize)
            function, args, of_held = ForkingPickler.loads(message.data)
        except EOFError:
            os._exit(0)  # the parent has died: skip the destructors of native libraries
        if cpu_s is not None:  # after so many more, the kernel ends this process in any code
            used = resource.getrusage(resource.RUSAGE_SELF)
            soft = math.ceil(used.ru_utime + used.ru_stime) + cpu_s
            hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
            resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))
        send(file, _answer(function, (_held, *args) if of_held else args))


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
