"""Networks: train and evaluate them; torch is loaded when a function is called."""

import os
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infra.torch_library import require_torch
from storage.installation import module_name
from train.monitoring.settings import WatchSettings
from train.resume import StartOptions
from train.runs import changed_run, named_run
from train.settings import TrainSettings

if TYPE_CHECKING:
    from infra.judging import Judgement, judge_network, write_judgement
    from train.progress import TrainProgress
    from train.result import TrainResult

__all__ = [
    "Judgement",
    "TrainResult",
    "TrainSettings",
    "WatchSettings",
    "judge_network",
    "named_run",
    "train_network",
    "write_judgement",
]

_PLACES = {
    "Judgement": "infra.judging",
    "TrainResult": "train.result",
    "judge_network": "infra.judging",
    "write_judgement": "infra.judging",
}
"""Modules of names that need torch."""


def train_network(
    run: str = "smoke",
    *,
    data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    steps: int | None = None,
    changes: Mapping[str, Any] | None = None,
    resume: bool = False,
    branch: str | None = None,
    decisions: Mapping[str, Any] | None = None,
    begin_with: str | None = None,
    lpips: str | None = None,
    workers: int | None = None,
    device: str | None = None,
    watched: WatchSettings | None = None,
    progress: "TrainProgress | None" = None,
) -> "TrainResult":
    """Train a network on a dataset and evaluate it, as `trilight train` does, in this process.

    The command trains on several processes or machines: `torchrun -m trilight train`.

    Args:
        run: named run, such as `smoke` or `pretrain`.
        data: root of a dataset with a train split, or several roots, mixed by `data_weights`.
        out: folder of the run.
        steps: number of steps instead of the run's.
        changes: other settings by dotted name, such as `{"model.width": 64}`.
        resume: resume from the folder's newest checkpoint.
        branch: checkpoint or folder of a run to resume from in the new folder `out`.
        decisions: settings by dotted name that change on resuming; the run records them.
        begin_with: initial network of a finetune run.
        lpips: folder of LPIPS' weights, or `hub`.
        workers: threads that decode samples; by default as many as the machine can spare.
        device: cpu or cuda; by default cuda where there is one.
        watched: monitoring settings, such as WatchSettings(profile=5).
        progress: receiver of the run's progress; none by default.

    Raises:
        TrilightError: PyTorch is not installed, a setting or the data is refused, or the folder
            already holds a run.
    """
    require_torch("train_network")
    settings = changed_run(run, changes or {}, steps=steps)
    start = StartOptions(
        resume=resume,
        branch=branch,
        decisions=decisions or {},
        begin_with=begin_with,
        lpips=lpips,
    )
    start.check(settings)
    return _train_alone(
        settings,
        start,
        roots=[data] if isinstance(data, str | os.PathLike) else data,
        out=Path(out),
        device=device,
        workers=workers,
        watched=watched,
        progress=progress,
    )


def _train_alone(
    settings: TrainSettings,
    start: StartOptions,
    *,
    roots: Sequence[str | os.PathLike[str]],
    out: Path,
    device: str | None,
    workers: int | None,
    watched: WatchSettings | None,
    progress: "TrainProgress | None",
) -> "TrainResult":
    """Train in this process as the only rank."""
    from train.loop.distributed import DistributedContext, choose_device
    from train.run import train_run

    result = train_run(
        settings,
        data=[os.fspath(root) for root in roots],
        out=out,
        start=start,
        dist_context=DistributedContext(device=choose_device(device)),
        workers=workers,
        watched=watched,
        progress=progress,
    )
    assert result is not None  # rank 0 returns a result
    return result


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require_torch(name)
    return getattr(import_module(module_name(_PLACES[name])), name)
