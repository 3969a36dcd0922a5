"""Workers against throughput: views per hour of 1, 2, 4 ... workers, rendering and merely waiting.

One `trilight generate --workers N` of the same tiny scenes for each N, each worker with one core of
its own (TRILIGHT_CORES), so that more workers than the machine has cores show where rendering ends
to grow. Scheduling alone has no such end: tasks that sleep instead of rendering, N at a time and
handed out as a flow's are, go on to many more workers than there are cores. Each of them stands for
a scene.

The first N scenes are left out, in which each worker starts and compiles; that workers run out of
work at the end, one after the other, counts.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt

from infra.bench.harness import Comparison, Options, compare
from infra.bench.orchestration import sleeping_flow, timed
from pipeline.flows.prefect_server import prefect_server, quiet_prefect
from storage.layout import DatasetFolder
from storage.scene_log import SceneLog, read_scene_logs

NAME = "orchestration-workers"
RENDERING, SLEEPING = (1, 2, 4), (1, 2, 4, 8, 16)
"""Numbers of workers."""
VIEWS = 4
"""Of a scene of `smoke`."""
TASKS_EACH = 4
"""Sleeping tasks of each worker."""
QUICK, CAREFUL = (16, 2.0), (48, 5.0)
"""Scenes to render, and seconds to sleep."""

Sleeping = Callable[[float, int, int], None]


def num_rounds(options: Options) -> int:
    """Return how often `round_done` will be called."""
    return (len(RENDERING) + len(SLEEPING)) * (1 + _repeats(options))


def run(options: Options, round_done: Callable[[], None]) -> Comparison:
    """Measure; quickly 16 scenes once and sleeps of 2 s, otherwise 48 scenes and 5 s, twice."""
    num_scenes, sleep_s = QUICK if options.quick else CAREFUL
    quiet_prefect()
    with prefect_server():
        sleeping = sleeping_flow()
        sides = {
            rendering(number): partial(_render, options, num_scenes, number) for number in RENDERING
        }
        sides |= {waiting(number): partial(_wait, sleeping, sleep_s, number) for number in SLEEPING}
        return compare(NAME, sides, repeats=_repeats(options), round_done=round_done)


def rendering(workers: int) -> str:
    """Return the name of the side in which so many workers render."""
    return f"{workers} rendering"


def waiting(workers: int) -> str:
    """Return the name of the side in which so many workers sleep."""
    return f"{workers} waiting"


def efficiency(result: Comparison, side: Callable[[int], str], workers: int) -> float:
    """Return the views per hour of some workers as a share of so many times those of one."""
    several, one = (result.sides[side(number)]["views_per_hour"] for number in (workers, 1))
    return several.median / (workers * one.median)


def views_per_hour(scenes: Sequence[SceneLog], workers: int) -> float:
    """Return the rate after each worker has made one scene, up to the end of the last.

    Args:
        scenes: all that were made, in any order; more than there are workers.
        workers: how many made them.
    """
    finished = sorted(scene.finished_unix_s for scene in scenes)
    span_s = finished[-1] - finished[workers - 1]
    return 3600 * VIEWS * (len(finished) - workers) / max(span_s, 0.1)  # logs say tenths


def rows(result: Comparison) -> list[tuple[str, str]]:
    """Return the result for people."""
    return [
        (name, _said(result, side, number))
        for side, numbers in ((rendering, RENDERING), (waiting, SLEEPING))
        for number in numbers
        if (name := side(number)) in result.sides
    ]


def _said(result: Comparison, side: Callable[[int], str], workers: int) -> str:
    rate = result.sides[side(workers)]["views_per_hour"]
    return (
        f"{rate.median:,.0f} views an hour ({rate.low:,.0f} to {rate.high:,.0f}), "
        f"{efficiency(result, side, workers):.1%} of {workers} times one"
    )


def plot(result: Comparison, path: Path) -> None:
    """Draw views per hour and efficiency against workers."""
    figure, (rates, shares) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for label, side, numbers in (
        ("rendering", rendering, RENDERING), ("waiting", waiting, SLEEPING)
    ):  # fmt: skip
        found = [result.sides[side(number)]["views_per_hour"] for number in numbers]
        median = [rate.median for rate in found]
        ends = [
            [rate.median - rate.low for rate in found],
            [rate.high - rate.median for rate in found],
        ]
        (line, *_) = rates.errorbar(numbers, median, yerr=ends, marker="o", capsize=3, label=label)
        ideal = [number * median[0] for number in numbers]
        rates.plot(numbers, ideal, linestyle=":", color=line.get_color())
        shares.plot(
            numbers, [100 * efficiency(result, side, n) for n in numbers], "o-", label=label
        )
    rates.plot([], [], linestyle=":", color="grey", label="so many times one")
    rates.set(yscale="log", ylabel="views an hour")
    shares.set(ylabel="per cent of so many times one", ylim=(0, 110))
    for axes in (rates, shares):
        axes.set_xscale("log", base=2)
        axes.set_xticks(SLEEPING, [str(number) for number in SLEEPING])
        axes.axvline(result.machine["cores"], color="grey", linewidth=0.8, label="cores")
        axes.set_xlabel("workers")
        axes.grid(alpha=0.3)
    rates.legend(fontsize="small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _repeats(options: Options) -> int:
    return 1 if options.quick else 2


def _wait(sleeping: Sleeping, sleep_s: float, workers: int) -> Mapping[str, float]:
    tasks = TASKS_EACH * workers
    return {
        "views_per_hour": 3600 * VIEWS * tasks / timed(lambda: sleeping(sleep_s, tasks, workers))
    }


def _render(options: Options, num_scenes: int, workers: int) -> Mapping[str, float]:
    with tempfile.TemporaryDirectory() as place:
        words = [sys.executable, "-m", "trilight", "generate", "smoke", "--out", place]
        words += ["--objects", options.objects[0], "--scenes", str(num_scenes)]
        words += ["--resolution", "64", "--noise-floor", "20", "--workers", str(workers)]
        subprocess.run(
            words,
            env={**os.environ, "TRILIGHT_CORES": str(workers)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        scenes = list(read_scene_logs(DatasetFolder(Path(place))))
    return {"views_per_hour": views_per_hour(scenes, workers)}
