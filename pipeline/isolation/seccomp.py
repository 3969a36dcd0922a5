"""Seccomp: a process gives up calls of Linux that reading a file never needs.

Refused are sockets, programs to start, other processes' memory, mounts, and parts of the kernel
that were a way out before. A refused call returns EPERM, so that a library can go on without it.
"""

import ctypes
import functools
import os
import platform
import struct
import sys
from collections.abc import Mapping

_NUMBERS: Mapping[str, tuple[int, int]] = {
    "socket": (41, 198),
    "connect": (42, 203),
    "bind": (49, 200),
    "listen": (50, 201),
    "sendto": (44, 206),
    "execve": (59, 221),
    "execveat": (322, 281),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "pidfd_getfd": (438, 438),
    "mount": (165, 40),
    "umount2": (166, 39),
    "pivot_root": (155, 41),
    "chroot": (161, 51),
    "unshare": (272, 97),
    "setns": (308, 268),
    "fsopen": (430, 430),
    "open_tree": (428, 428),
    "move_mount": (429, 429),
    "open_by_handle_at": (304, 265),
    "bpf": (321, 280),
    "perf_event_open": (298, 241),
    "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425),
    "io_uring_enter": (426, 426),
    "add_key": (248, 217),
    "request_key": (249, 218),
    "keyctl": (250, 219),
    "init_module": (175, 105),
    "finit_module": (313, 273),
    "kexec_load": (246, 104),
    "reboot": (169, 142),
}
"""What is refused, with its number on x86_64 and on aarch64."""

_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of `_NUMBERS`, and how the kernel calls the architecture."""
_OTHER_NUMBERS = 0x40000000  # x86_64's second set of calls, for 32-bit pointers

_LOAD, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_CALL_NUMBER_AT, _ARCHITECTURE_AT = 0, 4
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | 1  # EPERM

_SET_SECCOMP, _GET_SECCOMP, _FILTER = 22, 21, 2
_Step = tuple[int, int, int, int]


@functools.cache
def seccomp_works() -> bool:
    """Return whether calls can be given up here: the kernel can, and the machine's are known."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    # with no program it fails: by EFAULT where the kernel would look at one
    return libc.prctl(_SET_SECCOMP, _FILTER, None, 0, 0) < 0 and ctypes.get_errno() == 14


def refuse_calls() -> None:
    """Give up the calls for this thread and those that it starts; there is no way back.

    Raises:
        OSError: the kernel refuses; privileges must have been given up before.
    """
    steps = _program(platform.machine())
    packed = b"".join(struct.pack("=HBBI", *step) for step in steps)
    program = ctypes.create_string_buffer(packed, len(packed))
    given = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(program))
    if ctypes.CDLL(None, use_errno=True).prctl(_SET_SECCOMP, _FILTER, given, 0, 0) < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def _program(machine: str) -> list[_Step]:
    """Return the kernel's steps: by another architecture's number nothing may be called at all."""
    column, architecture = _MACHINES[machine]
    numbers = sorted(row[column] for row in _NUMBERS.values())
    tests: list[tuple[int, int]] = [(_AT_LEAST, _OTHER_NUMBERS)]
    tests += [(_EQUAL, number) for number in numbers]
    refuse = len(tests) + 1  # behind the step that allows
    return [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_EQUAL, 0, refuse + 1, architecture),
        (_LOAD, 0, 0, _CALL_NUMBER_AT),
        *((test, refuse - 1 - at, 0, value) for at, (test, value) in enumerate(tests)),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _REFUSE),
    ]
