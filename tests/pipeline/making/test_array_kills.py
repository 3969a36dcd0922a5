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

from pipeline.executors.array_job import array_job
from pipeline.executors.kubernetes import PLACE
from pipeline.executors.kubernetes_array import KubernetesOptions, job_manifest
from pipeline.executors.registry import find_executor
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from tests.conftest import ROOT
from tests.pipeline.making.array_maker import KILL_AFTER_S
from tests.pipeline.making.bucket_kit import OUT
from tests.pipeline.making.tiny_scenes_kit import Undocumented, tiny_order, without_rendering

OPTIONS = KubernetesOptions(image="not pulled", cores=2)


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
    """Each array goes on where the one before was killed: four of Kubernetes, then one of Slurm."""
    order, rng, killed = tiny_order(out=OUT, scenes=12), np.random.default_rng(0), 0
    without_rendering(monkeypatch)
    monkeypatch.setattr("pipeline.executors.threads.ThreadRunner", Undocumented)
    alone = dataclasses.replace(order, out=str(tmp_path / "whole"))
    find_executor("threads", None, None).make(alone, None)
    missing = [0, 1]
    for number, on in enumerate([*4 * ["kubernetes"], "slurm"]):
        job = array_job(order, per_task=2, at_once=None, on=on)
        assert set(job.tasks) <= set(missing)  # only what is missing
        missing = list(job.tasks)
        for place, task in enumerate(job.tasks):
            pod = job_manifest(job, OPTIONS)["spec"]["template"]["spec"]["containers"][0]
            variables = {row["name"]: row["value"] for row in pod["env"]}
            if on == "slurm":
                variables["SLURM_ARRAY_TASK_ID"] = str(task)
            else:
                variables |= {PLACE: str(place), KILL_AFTER_S: str(rng.uniform(0, 0.4))}
            variables["TRILIGHT_CACHE"] = str(tmp_path / f"{number}-{place}")
            run = _start([*pod["command"][:-1], on], variables)
            said, _ = run.communicate(timeout=300)
            assert run.returncode in (0, -9), said
            killed += run.returncode == -9
    assert killed >= 2
    assert array_job(order, per_task=2, at_once=None).tasks == []
    assert verify_dataset(OUT).problems == []
    assert open_dataset(OUT).digest == open_dataset(str(tmp_path / "whole")).digest
