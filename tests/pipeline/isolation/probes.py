"""What a child that a file has taken over would try, run behind one wall at a time."""

import contextlib
import ctypes
import errno
import fcntl
import os
import platform
import resource
import socket
import struct
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from pipeline.isolation import confinement, system_calls
from tests.conftest import ROOT

LIBC = ctypes.CDLL(None, use_errno=True)
_COLUMN = system_calls._MACHINES.get(platform.machine(), (0,))[0]
_CALLS: Mapping[str, tuple[object, ...]] = {**system_calls._NUMBERS, **system_calls._BY_ARGUMENT}


def kernel(call: str | int, *args: object) -> int:
    """Make a call of the kernel by its name here; OSError where it fails."""
    number = _CALLS[call][_COLUMN] if isinstance(call, str) else call
    result = int(LIBC.syscall(number, *(ctypes.c_long(a) if type(a) is int else a for a in args)))
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def fork() -> None:
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)


HERE = ctypes.addressof(_BUFFER := ctypes.create_string_buffer(8))


def _piece(address: int) -> bytes:
    return struct.pack("=2Q", address, 1)


Probe = Callable[[Path, int], object]
_TO_ONE = 0x100000000  # high bits, which the kernel does not look at
PROBES: Mapping[str, tuple[str, Probe]] = {
    "read": ("landlock 1", lambda path, pid: path.read_text()),
    "list": ("landlock 1", lambda path, pid: os.listdir(path.parent)),
    "write": ("landlock 1", lambda path, pid: path.write_text("")),
    "create": ("landlock 1", lambda path, pid: path.with_suffix(".new").touch()),
    "rename": ("landlock 1", lambda path, pid: path.rename(path.with_suffix(".gone"))),
    "unlink": ("landlock 1", lambda path, pid: path.unlink()),
    "symlink": ("landlock 1", lambda path, pid: path.with_suffix(".link").symlink_to("/etc")),
    "fifo": ("landlock 1", lambda path, pid: os.mkfifo(path.with_suffix(".fifo"))),
    "shared memory files": ("landlock 1", lambda path, pid: os.listdir("/dev/shm")),
    "root of proc": ("landlock 1", lambda path, pid: os.listdir(Path("/proc/self", "root", "etc"))),
    "environment": ("landlock 1", lambda path, pid: Path(f"/proc/{pid}/environ").read_bytes()),
    "compare": ("landlock 1, seccomp", lambda path, pid: kernel("kcmp", os.getpid(), pid, 0, 0, 0)),
    "memory": (
        "landlock 1, seccomp",
        lambda path, pid: kernel("process_vm_readv", pid, _piece(HERE), 1, _piece(8), 1, 0),
    ),
    "trace": ("seccomp", lambda path, pid: kernel("ptrace", 1, pid, 0, 0)),
    "mount": ("landlock 1, seccomp, rights", lambda path, pid: kernel("mount", 0, b"/", 0, 0, 0)),
    "truncate": ("landlock 3", lambda path, pid: os.truncate(path, 0)),
    "kill": ("landlock 6, seccomp", lambda path, pid: os.kill(pid, 0)),
    "queue a signal": ("seccomp", lambda path, pid: kernel("rt_sigqueueinfo", pid, 0, 0)),
    "signal by a handle": (
        "landlock 6, seccomp",
        lambda path, pid: kernel("pidfd_send_signal", os.pidfd_open(pid), 0, 0, 0),
    ),
    "signal by a file": ("seccomp", lambda path, pid: fcntl.fcntl(1, fcntl.F_SETOWN, pid)),
    "limits": ("seccomp", lambda path, pid: resource.prlimit(pid, resource.RLIMIT_CPU)),
    "priority": ("seccomp", lambda path, pid: os.setpriority(os.PRIO_PROCESS, pid, 19)),
    "affinity": ("seccomp", lambda path, pid: os.sched_setaffinity(pid, {0})),
    "scheduler": ("seccomp", lambda path, pid: kernel("sched_setattr", pid, 0, 0)),
    "chmod": ("seccomp", lambda path, pid: path.chmod(0o777)),
    "fchmodat2": ("seccomp", lambda path, pid: kernel("fchmodat2", -100, bytes(path), 0o777, 0)),
    "chown": ("seccomp, rights", lambda path, pid: os.chown(path, 12345, 12345)),
    "utime": ("seccomp", lambda path, pid: os.utime(path, (1, 1))),
    "attribute": ("seccomp", lambda path, pid: os.setxattr(path, "user.probe", b"1")),
    "attributes": ("seccomp", lambda path, pid: kernel("removexattr", bytes(path), b"user.x")),
    "flags": ("seccomp", lambda path, pid: kernel("ioctl", 1, 0x40086602, 0)),
    "type": ("seccomp", lambda path, pid: kernel("ioctl", 1, 0x5412, b"x")),
    "type, high bits": ("seccomp", lambda path, pid: kernel("ioctl", 1, 0x5412 + _TO_ONE, b"x")),
    "paste": ("seccomp", lambda path, pid: kernel("ioctl", 1, 0x541C, b"\3")),
    "internet": ("seccomp", lambda path, pid: socket.socket().close()),
    "datagrams": ("seccomp", lambda path, pid: socket.socket(type=socket.SOCK_DGRAM).close()),
    "unix socket": ("seccomp", lambda path, pid: socket.socket(socket.AF_UNIX).close()),
    "memory of others": ("seccomp", lambda path, pid: kernel("shmget", 0x5151, 0, 0)),
    "attach memory": ("seccomp", lambda path, pid: kernel("shmat", -1, 0, 0)),
    "remove memory": ("seccomp", lambda path, pid: kernel("shmctl", -1, 0, 0)),
    "semaphores": ("seccomp", lambda path, pid: kernel("semget", 0x5151, 0, 0)),
    "messages": ("seccomp", lambda path, pid: kernel("msgget", 0x5151, 0)),
    "message queue": ("seccomp", lambda path, pid: kernel("mq_open", b"probe", 0, 0, 0)),
    "watch": (
        "seccomp",
        lambda path, pid: kernel("inotify_add_watch", LIBC.inotify_init1(0), bytes(path), 2),
    ),
    "watch all": ("seccomp, rights", lambda path, pid: os.close(kernel("fanotify_init", 0, 0))),
    "fork": ("seccomp", lambda path, pid: fork()),
    "clone": ("seccomp", lambda path, pid: kernel("clone", 0x800, 0, 0, 0, 0)),
    "program": ("seccomp", lambda path, pid: os.execv("/no/such/program", ["x"])),
    "outlive": ("seccomp", lambda path, pid: kernel("prctl", 1, 0, 0, 0, 0)),
    "new namespace": ("seccomp", lambda path, pid: kernel("unshare", 0)),
    "ring": ("seccomp", lambda path, pid: kernel("io_uring_setup", 1, 0)),
    "bpf": ("seccomp", lambda path, pid: kernel("bpf", 99, 0, 0)),
    "keys": ("seccomp", lambda path, pid: kernel("keyctl", 99, 0, 0)),
    "second set": ("seccomp", lambda path, pid: kernel(39 | 0x40000000)),
    "kernel's words": ("seccomp", lambda path, pid: kernel("syslog", 10, 0, 0)),
    "clock": ("seccomp", lambda path, pid: kernel("clock_settime", 0, 0)),
    "host's name": (
        "seccomp, rights", lambda path, pid: socket.sethostname(socket.gethostname())
    ),
    "own limits": (
        "rights", lambda path, pid: kernel("prlimit64", 0, 4, struct.pack("=2Q", 4096, 4096), 0)
    ),
    "look up a name": ("", lambda path, pid: path.stat()),
    "own environment": ("", lambda path, pid: dict(os.environ)),
    "own signals and threads": ("", lambda path, pid: os.kill(os.getpid(), 0)),
}  # fmt: skip
"""Probes by name: the walls that hold each by themselves, with the first version of Landlock."""


def build(wall: str, inside: Path) -> None:
    """Confine this process by one wall alone."""
    name, _, version = wall.partition(" ")
    if name == "all":
        confinement.confine(confinement.reach([inside, ROOT]), frozenset())
    elif name == "rights":
        system_calls.give_up_privileges()
    elif name:
        LIBC.prctl(38, 1, 0, 0, 0)
    if name == "landlock":
        system_calls.landlock_version = lambda: int(version)  # type: ignore[assignment]
        system_calls.restrict_files(reads=[*confinement._libraries(), ROOT, inside], writes=[])
    if name == "seccomp":
        system_calls.refuse_calls()


def try_all(wall: str, folder: Path, victim: int) -> dict[str, bool | None]:
    """Return which probes a wall refuses, each with a file of its own; None of unknown calls."""
    build(wall, folder / "in")
    return {
        name: _is_refused(probe, folder / "probed" / name, victim)
        for name, (_, probe) in PROBES.items()
    }


def _is_refused(probe: Probe, path: Path, victim: int) -> bool | None:
    try:
        probe(path, victim)
    except PermissionError:
        return True
    except OSError as error:  # let in, and failed by what was asked
        return None if error.errno == errno.ENOSYS else False
    return False


def stay(path: Path, is_confined: bool) -> None:
    """Say who this is, and try not to end with the owner."""
    os.closerange(3, 256)
    if is_confined:
        with contextlib.suppress(PermissionError):
            kernel("prctl", 1, 0, 0, 0, 0)
    path.write_text(str(os.getpid()))
    time.sleep(60)


def open_terminals() -> list[int]:
    """Print a title for the terminal, and return the files that are one."""
    os.write(1, b"said\x1b]0;title\x07")
    return [file for file in range(256) if os.isatty(file)]
