"""Landlock: restricts a process to the files that it needs, by three system calls of Linux.

The calls are made through ctypes, since their numbers and structures never change, and the packages
that wrap them are young and have one maintainer each: too little for a security boundary.
"""

import ctypes
import functools
import os
import stat
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

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
        reads: files and folders to read.
        writes: files and folders to read and write; no device can be made there.
        lists: folders that may be listed, without read access to their files.

    Raises:
        OSError: the kernel refuses, or `landlock_version` is 0.
    """
    rights = (1 << _NUM_RIGHTS.get(landlock_version(), 16)) - 1
    ruleset = _new_ruleset(rights)
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


def _new_ruleset(rights: int) -> int:
    version = landlock_version()
    fields = [rights]
    if version >= _NET_SINCE:
        fields.append(_BIND_AND_CONNECT)
    if version >= _SCOPES_SINCE:
        fields.append(_SCOPES)
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    return _require(_libc().syscall(_CREATE, attributes, ctypes.c_size_t(len(attributes)), 0))


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
