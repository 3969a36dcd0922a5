"""The curve of workers: what counts of a run, what is said of it, and a tiny run of everything."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from infra.bench import workers
from infra.bench.harness import Comparison, Options, Spread
from storage.scene_log import SceneLog
from tests.conftest import ROOT

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=())


def _logs(*finished: float) -> list[SceneLog]:
    return [SceneLog(seconds=1.0, cores=1, finished_unix_s=1e9 + at) for at in finished]


def test_the_first_scene_of_each_worker_is_left_out_and_an_idle_end_is_not() -> None:
    """Two workers compile until 20 and 21; then six scenes take until 41, four views each."""
    scenes = _logs(41.0, 20.0, 25.0, 24.0, 21.0, 29.0, 28.0, 33.0)
    assert workers.views_per_hour(scenes, 2) == pytest.approx(3600 * 4 * 6 / 20)  # rounding
    assert workers.views_per_hour(scenes, 1) == pytest.approx(3600 * 4 * 7 / 21)
    assert workers.views_per_hour(_logs(5.0, 5.0), 1) == 3600 * 4 / 0.1  # the logs' resolution


def _by_hand() -> Comparison:
    def side(rate: float) -> dict[str, Spread]:
        return {"views_per_hour": Spread(median=rate, low=0.9 * rate, high=1.1 * rate)}

    sides = {workers.rendering(n): side(1000.0 * min(n, 2)) for n in workers.RENDERING}
    sides |= {workers.waiting(n): side(1440.0 * n * (1 - n / 100)) for n in workers.SLEEPING}
    return Comparison(name=workers.NAME, sides=sides, repeats=3)


def test_the_result_says_rate_and_efficiency(tmp_path: Path) -> None:
    result = _by_hand()
    lines = dict(workers.rows(result))
    assert list(lines) == [
        "1 rendering", "2 rendering", "4 rendering",
        "1 waiting", "2 waiting", "4 waiting", "8 waiting", "16 waiting",
    ]  # fmt: skip
    assert lines["4 rendering"] == "2,000 views an hour (1,800 to 2,200), 50.0% of 4 times one"
    assert lines["16 waiting"].endswith(f"{0.84 / 0.99:.1%} of 16 times one")
    workers.plot(result, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000


TINY_RUN = """
from infra.bench import workers
from tests.infra.test_bench_workers import OPTIONS
workers.RENDERING = workers.SLEEPING = (1, 2)
workers.QUICK = (4, 0.2)
rounds = []
result = workers.run(OPTIONS, lambda: rounds.append(None))
assert len(rounds) == workers.num_rounds(OPTIONS)
assert all(side["views_per_hour"].low > 0 for side in result.sides.values())
assert len(workers.rows(result)) == 4
"""


@pytest.mark.slow
def test_a_tiny_run() -> None:
    """In a process of its own, as `trilight bench` is: Prefect reads its settings once."""
    environment = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    done = subprocess.run(
        [sys.executable, "-c", TINY_RUN],
        cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
