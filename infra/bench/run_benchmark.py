"""Runs one benchmark (experiment): every point once in each trial, stored as soon as measured.

Machines drift. The points of an experiment are therefore measured alternately (A B A B ...), and
only ratios within one run are meaningful.
"""

import dataclasses
import os
import platform
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from infra.bench.context import BenchContext
from infra.bench.experiment import (
    BenchScale,
    Experiment,
    Point,
    Run,
    begin_run,
    device_of,
    public_options,
)
from infra.bench.rows import plot
from infra.bench_options import BenchOptions
from infra.torch_library import require_torch
from pipeline.isolation import ChildFailed
from storage.errors import Rejected, TrilightError
from storage.installation import installed_version
from storage.machine import processor

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results" / "bench"

_LIBRARIES = ("trilight", "mitsuba", "drjit", "pyoidn", "numpy", "torch", "pymeshlab",
              "wasmtime", "libigl", "OpenEXR", "h5py")  # fmt: skip


def results_path(name: str, scale: BenchScale) -> Path:
    """Return the default file of an experiment's results."""
    suffix = "" if scale.name == "full" else f"-{scale.name}"
    return RESULTS / f"{name}{suffix}.jsonl"


def run(
    experiment: Experiment,
    scale: BenchScale,
    options: BenchOptions,
    out: Path,
    trial_done: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Measure the missing trials of an experiment, draw its plot next to `out`; return its run.

    An interrupted run of the same plan resumes. Only its interrupted trial is measured again.

    Args:
        trial_done: called with the number of finished trials and of all trials.

    Raises:
        TrilightError: a requirement of the experiment is missing, or no trial could be measured.
    """
    name = experiment.name
    if "torch" in experiment.needs:
        require_torch(f"bench {name}")
    if "data" in experiment.needs and not options.data:
        raise TrilightError(
            f"bench {name}: --data is not given; expected the root of a finished dataset."
        )
    if "blender" in experiment.needs:
        from infra.bench.workloads.cycles import blender_python

        blender_python()  # before anything is measured
    points = _points_of(experiment, scale, options)
    plan = {
        "experiment": name,
        **_conditions(experiment, scale, options),
        "points": [point.record() for point in points],
        "trials": list(experiment.trials(scale, options)),
        **({"figures": list(experiment.figures)} if experiment.figures else {}),
    }
    current = begin_run(out, plan)
    began = time.perf_counter()
    missing = current.missing_trials()
    total = len(plan["trials"])
    with BenchContext(scale, options) as context:
        for number, trial in enumerate(missing, total - len(missing) + 1):
            try:
                for point in points:
                    if point.measure:
                        current.add(trial, point.name, point.measure(context, trial))
            except (Rejected, ChildFailed) as error:
                current.write(trial=trial, left_out=str(error))
            trial_done(number, total)
    if not current.whole_trials():
        reasons = "; ".join(sorted(set(current.left_out.values())))
        raise TrilightError(f"bench {name}: no trial could be measured: {reasons}.")
    # before the end is stored: a run that cannot be drawn is unfinished
    plot(experiment, current, out.with_suffix(".png"))
    current.write(seconds=time.perf_counter() - began, notes=context.notes)
    return current


def _conditions(experiment: Experiment, scale: BenchScale, options: BenchOptions) -> dict[str, Any]:
    """Return the part of a plan that says under which conditions figures are measured."""
    if experiment.versions is not None:
        versions = dict(experiment.versions(options))
        return {"scale": {"name": scale.name}, "options": {}, "machine": {"versions": versions}}
    return {
        "scale": dataclasses.asdict(scale),
        "options": public_options(options),
        "machine": machine_record(device_of(options) if "torch" in experiment.needs else "cpu"),
    }


def _points_of(experiment: Experiment, scale: BenchScale, options: BenchOptions) -> list[Point]:
    points = list(experiment.points(scale, options))
    counts = Counter(point.name for point in points)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise TrilightError(
            f"bench {experiment.name}: {twice[0]!r} is there twice; expected each network once, in "
            "folders of different names."
        )
    return points


def machine_record(device: str) -> dict[str, Any]:
    """Return the record of this machine as JSON values; on the device `cuda` with its GPU."""
    versions = {name: text for name in _LIBRARIES if (text := installed_version(name))}
    gpu = {}
    if device == "cuda":
        import torch

        gpu["gpu"] = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return {
        **gpu,
        "processor": processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": versions,
        "commit": commit_text(),
    }


def commit_text(root: Path = ROOT) -> str:
    """Return the commit of a checkout, with -dirty if files other than documents differ.

    Results are documents, so that a run that writes them resumes as the same commit.
    """
    if shutil.which("git") is None:
        return "unknown"  # an image has none

    def git(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["git", *words], cwd=root, capture_output=True, text=True, check=False
        )

    commit = git("describe", "--always").stdout.strip()
    changed = git("diff", "--quiet", "HEAD", "--", ".", ":(exclude)docs").returncode == 1
    return f"{commit}-dirty" if changed else commit or "unknown"
