"""Networks trained and judged; torch is loaded when a function is called."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infra.torch_library import require_torch
from train.monitoring.settings import WatchSettings
from train.runs import changed_run, named_run
from train.settings import TrainSettings
from train.start_options import StartOptions

if TYPE_CHECKING:
    from infra.judging import Judgement
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
    """Train a network on a dataset and judge it, as `trilight train` does, in this process.

    Several processes or machines train by the command: `torchrun -m trilight train`.

    Args:
        run: named run, such as `smoke` or `pretrain`.
        data: root of a dataset, with a train split, or several roots, whose scenes are mixed as the
            change `data_weights` says.
        out: folder of the run.
        steps: replaces the run's number of steps.
        changes: other settings by dotted name, such as `{"model.width": 64}`.
        resume: go on from the folder's newest checkpoint.
        branch: checkpoint, or folder of a run, to go on from in the new folder `out`.
        decisions: settings by dotted name that change where the run goes on, which it records.
        begin_with: network that a finetune run begins with.
        lpips: folder of LPIPS' weights, or `hub`.
        workers: threads that decode samples; as many as the machine has to spare unless said.
        device: cpu or cuda; by default cuda where there is one.
        watched: how the run is watched, such as WatchSettings(profile=5).
        progress: receives the progress of the run; by default nothing does.

    Raises:
        TrilightError: PyTorch is not installed, a setting or the data is refused, or the folder
            already holds a run.
    """
    require_torch("train_network")
    places = [data] if isinstance(data, str | os.PathLike) else data
    settings = changed_run(run, changes or {}, steps=steps)
    start = StartOptions(
        resume=resume,
        branch=branch,
        decisions=decisions or {},
        begin_with=begin_with,
        lpips=lpips,
    )
    start.check(settings)
    from train.loop.distributed import DistributedContext, choose_device
    from train.run import train_run

    result = train_run(
        settings,
        data=[os.fspath(place) for place in places],
        out=Path(out),
        start=start,
        dist_context=DistributedContext(device=choose_device(device)),
        workers=workers,
        watched=watched,
        progress=progress,
    )
    assert result is not None  # the first process of a crew of one
    return result


def judge_network(
    checkpoint: str | os.PathLike[str],
    *,
    data: str | os.PathLike[str],
    split: str = "test",
    resolution: int | None = None,
    most_scenes: int = 10**6,
    tracer_views: int = 64,
    lpips: str | None = None,
    device: str | None = None,
    done: Callable[[int, int], None] = lambda now, total: None,
) -> "Judgement":
    """Judge a network on a split of a dataset, as `trilight evaluate` does.

    Arguments, result and errors are those of infra.judging.judge_network; `data` is one dataset.

    Raises:
        TrilightError: also where PyTorch is not installed.
    """
    require_torch("judge_network")
    from infra import judging

    return judging.judge_network(
        os.fspath(checkpoint),
        [os.fspath(data)],
        split=split,
        resolution=resolution,
        most_scenes=most_scenes,
        tracer_views=tracer_views,
        lpips=lpips,
        device=device,
        done=done,
    )


def write_judgement(judgement: "Judgement", out: str | os.PathLike[str]) -> Path:
    """Write evaluation.json, evaluation.md and sheets of pictures into a folder; return it.

    It is `out`, or where another network's report is there, out-2, out-3 ...
    """
    from infra import judging

    return judging.write_judgement(judgement, Path(out))


def __getattr__(name: str) -> object:
    require_torch(name)
    if name == "Judgement":
        from infra.judging import Judgement

        return Judgement
    if name == "TrainResult":
        from train.result import TrainResult

        return TrainResult
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
