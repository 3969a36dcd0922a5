"""Arrays as real processes that share a bucket alone, killed at random and submitted again."""

import dataclasses
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.executors.arrays.job import array_job
from pipeline.executors.registry import INDEX_VARIABLES, find_executor
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from tests.conftest import ROOT
from tests.pipeline.making.array_maker import KILL_AFTER_S
from tests.pipeline.making.bucket_kit import OUT
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

SLURM = "slurm"


def _start(words: Sequence[str], environment: dict[str, str]) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "tests.pipeline.making.array_maker", *words[1:]],
        cwd=ROOT, env={**os.environ, **environment}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


@pytest.mark.slow("kills")
def test_arrays_that_are_killed_end_in_the_digest_of_one_that_was_not(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each scheduler's array goes on where the one before was killed."""
    order, rng, killed = tiny_order(out=OUT, scenes=12), np.random.default_rng(0), 0
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    alone = dataclasses.replace(order, out=str(tmp_path / "whole"))
    find_executor("threads", None, None).make(alone, None)
    missing = [0, 1]
    for on in (*INDEX_VARIABLES, SLURM):
        job = array_job(order, per_task=2, at_once=None, on=on)
        assert set(job.tasks) <= set(missing)  # only what is missing
        missing = list(job.tasks)
        for place, task in enumerate(job.tasks):
            variable = {"SLURM_ARRAY_TASK_ID": str(task)}
            if on != SLURM:
                after_s = str(rng.uniform(0, 0.4))
                variable = {INDEX_VARIABLES[on]: str(place), KILL_AFTER_S: after_s}
            cache = {"TRILIGHT_CACHE": str(tmp_path / f"{on}-{place}")}
            run = _start(job.words(on), {**job.environment, **variable, **cache})
            said, _ = run.communicate(timeout=300)
            assert run.returncode in (0, -9), said
            killed += run.returncode == -9
    assert killed >= 2
    assert array_job(order, per_task=2, at_once=None).tasks == []
    assert verify_dataset(OUT).problems == []
    assert open_dataset(OUT).digest == open_dataset(str(tmp_path / "whole")).digest
