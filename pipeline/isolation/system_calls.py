"""Landlock and seccomp: restrict a process to the files and system calls that it needs.

Both are made through ctypes, since their numbers and structures never change, and the packages that
wrap them are young and have one maintainer each: too little for a security boundary.
"""

import ctypes
import functools
import os
import platform
import stat
import struct
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

_CREATE = 444
_ADD_RULE = 445
_RESTRICT = 446  # on every architecture
_ASK_VERSION = 1
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38
_CAPABILITIES = 0x20080522
"""Version of `capget`'s structures: two triples of effective, permitted and inherited bits."""
_OF_FILES = 1 << 1 | 1 << 2
"""Capabilities to read and write files of other accounts, as far as Landlock allows."""

_EXECUTE, _WRITE_FILE, READ_FILE, LIST = (1 << bit for bit in range(4))
_TRUNCATE = 1 << 14
_DEVICE_CALLS = 1 << 15
_ABOUT_FILES = _EXECUTE | _WRITE_FILE | READ_FILE | _TRUNCATE | _DEVICE_CALLS
_SPECIAL = 1 << 6 | 1 << 9 | 1 << 10 | 1 << 11  # make devices, sockets and pipes with names
_NUM_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}
"""Number of file rights by Landlock version; 16 from the fifth on."""
_BIND_AND_CONNECT = 3
_NET_SINCE = 4
_SCOPES_SINCE = 6
_SCOPES = 3  # no abstract socket and no signal to a process outside


@functools.cache
def landlock_version() -> int:
    """Return the version of the kernel's Landlock; 0 if it is missing or switched off."""
    if sys.platform != "linux":
        return 0
    return max(0, int(_libc().syscall(_CREATE, None, 0, _ASK_VERSION)))


def give_up_privileges() -> None:
    """Drop all capabilities of root except those for files, and all ways to regain them.

    Raises:
        OSError: the kernel refuses.
    """
    _require(_libc().prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    head = struct.pack("=Ii", _CAPABILITIES, 0)
    sets = ctypes.create_string_buffer(24)
    _require(_libc().capget(head, sets))
    effective, permitted, *_ = (held & _OF_FILES for held in struct.unpack("=6I", sets.raw))
    _require(_libc().capset(head, struct.pack("=6I", effective, permitted, 0, 0, 0, 0)))


def restrict_files(
    *, reads: Iterable[Path], writes: Iterable[Path], lists: Iterable[Path] = ()
) -> None:
    """Restrict this thread, and those that it starts, to some paths and everything below them.

    Missing paths are left out. The restriction is permanent. If the kernel supports it, TCP, and
    signals and abstract sockets to processes outside, are blocked too.

    Args:
        writes: files and folders to read and write; no device can be made there.
        lists: folders that may be listed, without read access to their files.

    Raises:
        OSError: the kernel refuses, or `landlock_version` is 0.
    """
    version = landlock_version()
    rights = (1 << _NUM_RIGHTS.get(version, 16)) - 1
    fields = [rights]
    if version >= _NET_SINCE:
        fields.append(_BIND_AND_CONNECT)
    if version >= _SCOPES_SINCE:
        fields.append(_SCOPES)
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    ruleset = _require(_libc().syscall(_CREATE, attributes, ctypes.c_size_t(len(attributes)), 0))
    try:
        for paths, access in (
            (lists, LIST),
            (reads, READ_FILE | LIST | _EXECUTE),
            (writes, rights & ~_SPECIAL & ~_EXECUTE),
        ):
            for path in paths:
                _allow(ruleset, path, access & rights)
        _require(_libc().syscall(_RESTRICT, ruleset, 0))
    finally:
        os.close(ruleset)


def _allow(ruleset: int, path: Path, rights: int) -> None:
    try:
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # a missing path needs no rule
    try:
        if not stat.S_ISDIR(os.fstat(opened).st_mode):
            rights &= _ABOUT_FILES
        if rights:
            rule = struct.pack("=Qi", rights, opened)
            _require(_libc().syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
    finally:
        os.close(opened)


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _require(answer: int) -> int:
    if answer < 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return answer


# Seccomp blocks sockets, new processes and programs, access to other processes, changes of
# permissions and times of files, and kernel features that were exploited before. A blocked call
# returns EPERM, so that a library can continue without it.
_NUMBERS: Mapping[str, tuple[int | None, int | None]] = {
    "socket": (41, 198), "connect": (42, 203), "bind": (49, 200), "listen": (50, 201),
    "sendto": (44, 206),
    "execve": (59, 221), "execveat": (322, 281), "fork": (57, None), "vfork": (58, None),
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271),
    "process_madvise": (440, 440), "process_mrelease": (448, 448), "kcmp": (312, 272),
    "migrate_pages": (256, 238), "move_pages": (279, 239), "pidfd_getfd": (438, 438),
    "tkill": (200, 130), "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240),
    "pidfd_send_signal": (424, 424),
    "setpriority": (141, 140), "ioprio_set": (251, 30), "sched_setaffinity": (203, 122),
    "sched_setscheduler": (144, 119), "sched_setparam": (142, 118), "sched_setattr": (314, 274),
    "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452),
    "chown": (92, None), "lchown": (94, None), "fchown": (93, 55), "fchownat": (260, 54),
    "utime": (132, None), "utimes": (235, None), "futimesat": (261, None), "utimensat": (280, 88),
    "setxattr": (188, 5), "lsetxattr": (189, 6), "fsetxattr": (190, 7), "setxattrat": (463, 463),
    "removexattr": (197, 14), "lremovexattr": (198, 15), "fremovexattr": (199, 16),
    "removexattrat": (466, 466), "file_setattr": (469, 469),
    "shmget": (29, 194), "shmat": (30, 196), "shmctl": (31, 195),
    "semget": (64, 190), "semop": (65, 193), "semtimedop": (220, 192), "semctl": (66, 191),
    "msgget": (68, 186), "msgsnd": (69, 189), "msgrcv": (70, 188), "msgctl": (71, 187),
    "mq_open": (240, 180), "mq_unlink": (241, 181),
    "inotify_add_watch": (254, 27), "fanotify_init": (300, 262), "syslog": (103, 116),
    "mount": (165, 40), "umount2": (166, 39), "pivot_root": (155, 41), "chroot": (161, 51),
    "unshare": (272, 97), "setns": (308, 268), "fsopen": (430, 430), "open_tree": (428, 428),
    "move_mount": (429, 429), "open_by_handle_at": (304, 265),
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282),
    "io_uring_setup": (425, 425), "io_uring_enter": (426, 426),
    "add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219),
    "init_module": (175, 105), "finit_module": (313, 273), "kexec_load": (246, 104),
    "reboot": (169, 142), "clock_settime": (227, 112), "sethostname": (170, 161),
    "setdomainname": (171, 162),
}  # fmt: skip
"""Blocked calls with their numbers on x86_64 and on aarch64; None if there is none."""

_OWN = -1
"""Stands for the number of this process."""
_Test = Literal["one of", "none of", "has"]
_BY_ARGUMENT: Mapping[str, tuple[int, int, int, _Test, tuple[int, ...]]] = {
    # type into a terminal; have signals sent; change a file's flags
    "ioctl": (16, 29, 1, "none of",
              (0x5412, 0x541C, 0x8901, 0x8902, 0x40086602, 0x40046602, 0x401C5820)),
    "fcntl": (72, 25, 1, "none of", (8, 10, 15)),  # have signals sent: F_SETOWN and its kin
    "prctl": (157, 167, 0, "none of", (1,)),  # PR_SET_PDEATHSIG: outlive the owner
    "prlimit64": (302, 261, 0, "one of", (0, _OWN)),
    "kill": (62, 129, 0, "one of", (_OWN,)),
    "tgkill": (234, 131, 0, "one of", (_OWN,)),
    "clone": (56, 220, 0, "has", (0x10000,)),  # CLONE_THREAD: threads, and no new process
}  # fmt: skip
"""Calls that are allowed by the low 32 bits of one argument: numbers of the call, index of the
argument, test, and values."""

_CLONE3 = 435
"""Answered with ENOSYS, since its arguments lie in memory: libraries then call `clone` instead."""
_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Column of the call numbers, and the kernel's number of the architecture."""
_OTHER_NUMBERS = 0x40000000  # x86_64's second set of calls, for 32-bit pointers

_LOAD = 0x20
_EQUAL = 0x15
_AT_LEAST = 0x35
_HAS = 0x45
_RETURN = 0x06
_CALL_NUMBER_AT = 0
_ARCHITECTURE_AT = 4
_ARGUMENTS_AT = 16
_ALLOW = 0x7FFF0000
_REFUSE = 0x00050000 | 1
_UNKNOWN = 0x00050000 | 38  # EPERM, ENOSYS

_SET_SECCOMP = 22
_FILTER = 2
_Step = tuple[int, int, int, int]


@functools.cache
def seccomp_works() -> bool:
    """Return True if the kernel supports seccomp and the machine's call numbers are known."""
    if sys.platform != "linux" or platform.machine() not in _MACHINES:
        return False
    # a call without a program fails with EFAULT if the kernel supports filters
    return _libc().prctl(_SET_SECCOMP, _FILTER, None, 0, 0) < 0 and ctypes.get_errno() == 14


def refuse_calls() -> None:
    """Block the calls for this thread and those that it starts, permanently.

    Raises:
        OSError: the kernel refuses; `give_up_privileges` must have been called before.
    """
    steps = _program(platform.machine(), os.getpid())
    packed = b"".join(struct.pack("=HBBI", *step) for step in steps)
    program = ctypes.create_string_buffer(packed, len(packed))
    header = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(program))
    _require(_libc().prctl(_SET_SECCOMP, _FILTER, header, 0, 0))


def _program(machine: str, process_id: int) -> list[_Step]:
    """Return the filter program; it blocks every call of another architecture."""
    column, architecture = _MACHINES[machine]
    steps = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _REFUSE),
        (_LOAD, 0, 0, _CALL_NUMBER_AT),
        *_where(_AT_LEAST, _OTHER_NUMBERS, (_RETURN, 0, 0, _REFUSE)),
        *_where(_EQUAL, _CLONE3, (_RETURN, 0, 0, _UNKNOWN)),
    ]
    for row in _NUMBERS.values():
        if (number := row[column]) is not None:
            steps += _where(_EQUAL, number, (_RETURN, 0, 0, _REFUSE))
    for *numbers, position, test, values in _BY_ARGUMENT.values():
        held, other = (_REFUSE, _ALLOW) if test == "none of" else (_ALLOW, _REFUSE)
        by_value = [(_LOAD, 0, 0, _ARGUMENTS_AT + 8 * position)]
        for value in values:
            operand = process_id if value == _OWN else value
            by_value += _where(_HAS if test == "has" else _EQUAL, operand, (_RETURN, 0, 0, held))
        steps += _where(_EQUAL, numbers[column], *by_value, (_RETURN, 0, 0, other))
    return [*steps, (_RETURN, 0, 0, _ALLOW)]


def _where(test: int, value: int, *then: _Step) -> list[_Step]:
    """Return steps that run only if the loaded value passes a test."""
    return [(test, 0, len(then), value), *then]
