"""Loads a library of the system, or a stand-in where the system lacks it.

pymeshlab's wheel links to OpenGL and never calls it here. Dr.Jit's links to GCC's libatomic for one
function. A stand-in is a small ELF file in memory: it has the name that the loader looks for, and
that function. Where the system has the library, it is used.
"""

import ctypes
import os
import platform
import struct
import sys
from collections.abc import Mapping

_PAGE = 4096

_COMPARE_EXCHANGE_16 = bytes.fromhex(
    "53"  # push rbx
    "4889d3"  # mov rbx, rdx: the new value is rcx:rbx
    "488b06 488b5608"  # mov rax, [rsi]; mov rdx, [rsi + 8]: the expected one is rdx:rax
    "f0480fc70f"  # lock cmpxchg16b [rdi]
    "7407"  # je +7
    "488906 48895608"  # mov [rsi], rax; mov [rsi + 8], rdx: the value that was there
    "0f94c0"  # sete al
    "5b c3"  # pop rbx; ret
)
"""`bool __atomic_compare_exchange_16(void *, void *, __int128, int, int)` for x86-64."""

_FUNCTIONS: Mapping[str, Mapping[str, bytes]] = {
    "libGL.so.1": {},
    "libOpenGL.so.0": {},
    "libatomic.so.1": {"__atomic_compare_exchange_16": _COMPARE_EXCHANGE_16},
}
"""Machine code of the functions of each library for which there is a stand-in."""

_VERSION = "LIBATOMIC_1.0"
"""Version of all functions: the loader compares it."""


def load_library(name: str) -> None:
    """Load a library of the system, or its stand-in, so that libraries which need it find it.

    There are stand-ins on x86-64 alone: elsewhere what needs the library says that it is missing.
    """
    try:
        ctypes.CDLL(name)
    except OSError:
        if sys.platform == "linux" and platform.machine() == "x86_64":
            load_stand_in(name)


def load_stand_in(name: str) -> ctypes.CDLL:
    """Return the stand-in of a library, loaded."""
    memory = os.memfd_create(name)  # stays open: the loader knows a library by its path
    os.write(memory, _elf_file(name, _FUNCTIONS[name]))
    return ctypes.CDLL(f"/proc/self/fd/{memory}")


def _elf_file(name: str, functions: Mapping[str, bytes]) -> bytes:
    """Return a shared library for x86-64 (System V ABI, chapters 4 and 5; GNU's versions)."""
    file = bytearray(64 + 4 * 56)  # the header and the segments, which are written at the end

    def append(data: bytes) -> int:
        """Append data at a multiple of 16, and return the place."""
        file.extend(bytes(-len(file) % 16))
        file.extend(data)
        return len(file) - len(data)

    code = [append(machine_code) for machine_code in functions.values()]
    texts = [name, _VERSION, *functions]
    starts = [1 + sum(len(text) + 1 for text in texts[:index]) for index in range(len(texts))]
    count = 1 + len(functions)
    # One bucket: each symbol names the one before it, and 0 ends the chain.
    chain = struct.pack(f"<{3 + count}I", 1, count, count - 1, 0, *range(count - 1))
    symbols = bytes(24) + b"".join(
        struct.pack("<IBBHQQ", text, 0x12, 0, 1, place, len(machine_code))
        for text, place, machine_code in zip(starts[2:], code, functions.values(), strict=True)
    )
    versions = b"".join(
        struct.pack("<4H3I2I", 1, number == 1, number, 1, _hash(text), 20, after, start, 0)
        for number, text, after, start in ((1, name, 28, starts[0]), (2, _VERSION, 0, starts[1]))
    )
    entries = [
        (14, starts[0]),  # SONAME
        (4, append(chain)),  # HASH
        (5, append(b"\0" + b"".join(text.encode() + b"\0" for text in texts))),  # STRTAB
        (6, append(symbols)),  # SYMTAB
        (10, sum(len(text) + 1 for text in texts) + 1),  # STRSZ
        (11, 24),  # SYMENT
        (0x6FFFFFF0, append(struct.pack(f"<{count}H", 0, *[2] * len(functions)))),  # VERSYM
        (0x6FFFFFFC, append(versions)),  # VERDEF
        (0x6FFFFFFD, 2),  # VERDEFNUM
        (0, 0),
    ]
    dynamic = b"".join(struct.pack("<2Q", *entry) for entry in entries)
    segments = (
        (1, 5, 0, len(file), _PAGE),  # LOAD, to read and to run
        (1, 6, _PAGE, len(dynamic), _PAGE),  # LOAD, writable: glibc before 2.35 writes into it
        (2, 6, _PAGE, len(dynamic), 8),  # DYNAMIC
        (0x6474E551, 6, 0, 0, 16),  # GNU_STACK, not to run
    )
    file[:64] = b"\x7fELF\x02\x01\x01".ljust(16, b"\0") + struct.pack(
        "<2HI3QI6H", 3, 62, 1, 0, 64, 0, 0, 64, 56, len(segments), 64, 0, 0
    )
    file[64 : 64 + 4 * 56] = b"".join(
        struct.pack("<2I6Q", kind, flags, start, start, start, size, size, alignment)
        for kind, flags, start, size, alignment in segments
    )
    return bytes(file).ljust(_PAGE, b"\0") + dynamic


def _hash(text: str) -> int:
    """Return the System V hash of a name."""
    value = 0
    for byte in text.encode():
        value = (value << 4) + byte
        value = (value ^ (value >> 24 & 0xF0)) & 0x0FFFFFFF
    return value
