"""Landlock: a process gives up the files that it does not need, by three calls of Linux.

The calls are made through ctypes, since their numbers and structures are fixed for good, and the
packages that wrap them are young and kept by one person each: a wall is not where to trust those.
"""

import ctypes
import functools
import os
import stat
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

_CREATE, _ADD_RULE, _RESTRICT = 444, 445, 446  # on every architecture
_ASK_VERSION = 1
_PATH_BENEATH = 1
_NO_NEW_PRIVILEGES = 38
_CAPABILITIES = 0x20080522
"""Version of the structures of `capget`: two times what is effective, permitted, inherited."""
_OF_FILES = 1 << 1 | 1 << 2
"""Capabilities to read and write what another account owns, where Landlock lets one."""

_EXECUTE, _WRITE_FILE, READ_FILE, LIST = (1 << bit for bit in range(4))
_TRUNCATE, _DEVICE_CALLS = 1 << 14, 1 << 15
_ABOUT_FILES = _EXECUTE | _WRITE_FILE | READ_FILE | _TRUNCATE | _DEVICE_CALLS
_SPECIAL = 1 << 6 | 1 << 9 | 1 << 10 | 1 << 11  # make devices, sockets and pipes with names
_NUM_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}
"""Rights over files that a version knows; 16 from the fifth on."""
_BIND_AND_CONNECT = 3
_NET_SINCE, _SCOPES_SINCE = 4, 6
_SCOPES = 3  # no abstract socket and no signal to a process outside


@functools.cache
def landlock_version() -> int:
    """Return the version of the kernel's Landlock; 0 where there is none, or it is switched off."""
    if sys.platform != "linux":
        return 0
    return max(0, int(_libc().syscall(_CREATE, None, 0, _ASK_VERSION)))


def give_up_privileges() -> None:
    """Give up what root may more than others, but for files, and all ways to get that back.

    Raises:
        OSError: the kernel refuses.
    """
    _require(_libc().prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    head, sets = struct.pack("=Ii", _CAPABILITIES, 0), ctypes.create_string_buffer(24)
    _require(_libc().capget(head, sets))
    effective, permitted, *_ = (held & _OF_FILES for held in struct.unpack("=6I", sets.raw))
    _require(_libc().capset(head, struct.pack("=6I", effective, permitted, 0, 0, 0, 0)))


def restrict_files(
    *, reads: Iterable[Path], writes: Iterable[Path], lists: Iterable[Path] = ()
) -> None:
    """Leave this thread, and those that it starts, with these paths and what is below them.

    Paths that do not exist are left out. There is no way back. Where the kernel can, TCP, signals
    and abstract sockets to processes outside end too.

    Args:
        reads: files and folders to read.
        writes: files and folders to read and write; no device can be made there.
        lists: folders to list, with nothing in them to be read.

    Raises:
        OSError: the kernel refuses, or `landlock_version` is 0.
    """
    rights = (1 << _NUM_RIGHTS.get(landlock_version(), 16)) - 1
    ruleset = _new_ruleset(rights)
    try:
        for paths, wanted in (
            (lists, LIST),
            (reads, READ_FILE | LIST | _EXECUTE),
            (writes, rights & ~_SPECIAL & ~_EXECUTE),
        ):
            for path in paths:
                _allow(ruleset, path, wanted & rights)
        _require(_libc().syscall(_RESTRICT, ruleset, 0))
    finally:
        os.close(ruleset)


def _new_ruleset(rights: int) -> int:
    version = landlock_version()
    fields = [rights]
    if version >= _NET_SINCE:
        fields.append(_BIND_AND_CONNECT)
    if version >= _SCOPES_SINCE:
        fields.append(_SCOPES)
    given = struct.pack(f"={len(fields)}Q", *fields)
    return _require(_libc().syscall(_CREATE, given, ctypes.c_size_t(len(given)), 0))


def _allow(ruleset: int, path: Path, rights: int) -> None:
    try:
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # what cannot be reached needs no right
    try:
        if not stat.S_ISDIR(os.fstat(opened).st_mode):
            rights &= _ABOUT_FILES
        if rights:
            given = struct.pack("=Qi", rights, opened)
            _require(_libc().syscall(_ADD_RULE, ruleset, _PATH_BENEATH, given, 0))
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
