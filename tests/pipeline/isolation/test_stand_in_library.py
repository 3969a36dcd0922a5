"""Stand-ins for libraries of the system: the loader takes them, and their function works."""

import ctypes
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from pipeline.isolation.stand_in_library import load_stand_in

_WORD = ctypes.c_uint64


@pytest.fixture(scope="module")
def compare_exchange() -> Any:
    function = load_stand_in("libatomic.so.1").__getattr__("__atomic_compare_exchange_16")
    function.restype = ctypes.c_bool
    # the last argument is a number of 16 bytes, which two registers hold; then two memory orders
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, _WORD, _WORD, ctypes.c_int, ctypes.c_int]
    return function


def _aligned_pair() -> tuple[Any, Any]:
    """Return a buffer, and two numbers in it at a multiple of 16 bytes."""
    room = ctypes.create_string_buffer(32)
    offset = -ctypes.addressof(room) % 16
    return room, (_WORD * 2).from_buffer(room, offset)


def test_it_exchanges_sixteen_bytes_where_all_are_as_expected(
    compare_exchange: Any,
) -> None:
    room, value = _aligned_pair()
    value[:] = 5, 6
    for expected in ((5, 7), (4, 6)):
        found = (_WORD * 2)(*expected)
        assert not compare_exchange(ctypes.byref(value), found, 1, 2, 5, 5)
        assert (list(value), list(found)) == ([5, 6], [5, 6])
    found = (_WORD * 2)(5, 6)
    assert compare_exchange(ctypes.byref(value), found, 1, 2, 5, 5)
    assert list(value) == [1, 2]
    assert room is not None


def test_threads_lose_no_exchange(compare_exchange: Any) -> None:
    """ctypes holds no lock of Python in a call, so two processors meet."""
    room, value = _aligned_pair()
    times = 20_000

    def count() -> None:
        known = (_WORD * 2)(0, 0)
        for _ in range(times):
            while not compare_exchange(
                ctypes.byref(value), known, known[0] + 1, known[1] - 1 & (1 << 64) - 1, 5, 5
            ):
                pass

    with ThreadPoolExecutor(2) as threads:
        for done in [threads.submit(count) for _ in range(2)]:
            done.result()
    assert list(value) == [2 * times, (1 << 64) - 2 * times]
    assert room is not None


_STAND_INS = """
from pipeline.isolation.stand_in_library import load_stand_in
for name in ("libGL.so.1", "libOpenGL.so.0", "libatomic.so.1"):
    load_stand_in(name)
"""


@pytest.mark.parametrize(
    "use",
    [
        "from pipeline.assets.recipe import missing_filters as it; assert it() == []",
        "from pipeline.renders import mitsuba_variant as it; it.activate(it.choose_variant());"
        "import drjit, mitsuba; assert drjit.sum(drjit.arange(mitsuba.UInt32, 1000000))[0] > 0",
    ],
    ids=["pymeshlab", "mitsuba"],
)
def test_wheels_that_link_to_a_missing_library_run_with_its_stand_in(use: str) -> None:
    """The loader takes a library that is there under the name it looks for, as on a bare system."""
    maps = "assert 'libatomic.so.1.' not in open('/proc/self/maps').read()"
    subprocess.run([sys.executable, "-c", _STAND_INS + use + "\n" + maps], check=True)
