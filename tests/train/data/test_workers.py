"""The default of `--workers`: what a machine, its control group and the other processes leave."""

import dataclasses
from pathlib import Path

import pytest

from tests.for_each import for_each
from tests.train.kit import tiny_run
from train.data.workers import MOST_THREADS, Machine, fitting_workers, this_machine

GIB = 1 << 30


def system(root: Path, files: dict[str, str]) -> Path:
    """Write files of a system into a folder; returns it."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


@for_each(
    ("files", "cores", "free"),
    [
        ({}, 16.0, None),
        ({"proc/meminfo": "MemFree: 1 kB\nMemAvailable: 2097152 kB\n"}, 16.0, 2 * GIB),
        ({"sys/fs/cgroup/cpu.max": "350000 100000\n"}, 3.5, None),
        ({"sys/fs/cgroup/cpu.max": "max 100000\n"}, 16.0, None),
        (
            {
                "proc/self/cgroup": "0::/job/step\n",
                "sys/fs/cgroup/job/cpu.max": "400000 100000",
                "sys/fs/cgroup/job/step/cpu.max": "max 100000",
                "sys/fs/cgroup/job/memory.max": f"{8 * GIB}",
                "sys/fs/cgroup/job/memory.current": f"{5 * GIB}",
                "proc/meminfo": "MemAvailable: 104857600 kB\n",
            },
            4.0,
            3 * GIB,
        ),
        (
            {
                "proc/self/cgroup": "0::/job\n",
                "sys/fs/cgroup/job/memory.max": f"{8 * GIB}",
                "sys/fs/cgroup/job/memory.current": f"{8 * GIB}",
                "sys/fs/cgroup/job/memory.stat": f"anon {2 * GIB}\ninactive_file {6 * GIB}\n",
            },
            16.0,
            6 * GIB,
        ),
        (
            {
                "proc/self/cgroup": "4:memory:/x\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "200000",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": "1000",
            },
            2.0,
            None,
        ),
    ],
)
def test_a_machine_is_what_its_files_say(
    files: dict[str, str],
    cores: float,
    free: int | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    found = this_machine(system(tmp_path, files))
    assert found == Machine(cores=cores, free_bytes=free, processes=2)


@for_each(
    ("machine", "on_card", "threads", "said"),
    [
        (Machine(cores=2), False, 1, "1 thread decodes samples, by 2 cores"),
        (Machine(cores=2), True, 1, "1 thread decodes"),
        (Machine(cores=3.5), False, 2, "by 3.5 cores"),
        (Machine(cores=8), True, 7, "7 threads decode samples, by 8 cores"),
        (Machine(cores=208, processes=8), True, MOST_THREADS, "by 208 cores for 8 processes"),
        (Machine(cores=32, processes=8), True, 3, "3 threads"),
        (Machine(cores=1, processes=4), False, 1, "1 thread"),
        (Machine(cores=64, free_bytes=GIB // 16), True, 5, "64 cores and 0.1 GiB of free memory"),
    ],
)
def test_threads_are_what_is_spare(
    machine: Machine, on_card: bool, threads: int, said: str
) -> None:
    run = dataclasses.replace(tiny_run(resolution=256), views_per_scene=2)
    found = fitting_workers(machine, run, on_card=on_card, busy_threads=1)
    assert found.threads == threads and said in found.because
