"""Time under Python's lock, measured and simulated."""

import os
import zlib
from collections.abc import Callable

import pytest

from infra.bench.sides.lock_simulation import Part, samples_a_second
from infra.bench.sides.lock_time import with_lock_time
from tests.for_each import case


def ready(kind: str) -> Callable[[], int]:
    packed = zlib.compress(os.urandom(1000) * 4_000)

    def work() -> int:
        for _ in range(60):
            if kind == "python":
                sum(range(300_000))
            else:
                zlib.crc32(zlib.decompress(packed))
        return 60

    return work


@pytest.mark.slow("benchmarks")
def test_what_lets_the_lock_go_is_told_from_what_holds_it() -> None:
    holds, lets_go = with_lock_time(ready, "python"), with_lock_time(ready, "zlib")
    if "lock_s" not in holds:
        pytest.skip("this Python does not tell whether its lock is held")
    assert holds["lock_s"] > 0.8 * holds["core_s"] > 0
    assert lets_go["lock_s"] < 0.5 * lets_go["core_s"]


RATES = [
    (5e-3, 0.0, 0.0, 1, 200),
    (5e-3, 0.0, 0.0, 8, 1600),
    (3e-3, 2e-3, 0.0, 8, 500),
    (3e-3, 2e-3, 3e-3, 8, 200),
    (0.0, 1e-3, 9e-3, 4, 100),
]


def test_cores_end_what_threads_do_until_the_lock_does() -> None:
    for free_s, locked_s, main_s, threads, expected in RATES:
        with case(expected):
            decoding = Part(free_s=free_s, locked_s=locked_s, pieces=20)
            consuming = Part(free_s=0.0, locked_s=main_s, pieces=50)
            rate = samples_a_second(decoding, consuming, threads, ahead=32, seconds=3.0)
            assert rate == pytest.approx(expected, rel=0.06)
