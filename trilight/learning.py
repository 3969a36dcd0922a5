"""Networks from Python: train them; torch is loaded when the function is called."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from infra.torch_library import require_torch
from train.presets import override_training_preset
from train.resume import StartOptions
from train.settings import WatchSettings

if TYPE_CHECKING:
    from train.progress import TrainProgress
    from train.run_training import TrainResult


def train_network(
    run: str = "smoke",
    *,
    data: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    steps: int | None = None,
    changes: Mapping[str, Any] | None = None,
    resume: bool = False,
    branch: str | os.PathLike[str] | None = None,
    decisions: Mapping[str, Any] | None = None,
    begin_with: str | os.PathLike[str] | None = None,
    lpips: str | os.PathLike[str] | None = None,
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
    from train.loop.distributed import DistributedContext, choose_device
    from train.run_training import run_training

    places = {"branch": branch, "begin_with": begin_with, "lpips": lpips}
    named: dict[str, Any] = {k: os.fspath(v) for k, v in places.items() if v is not None}
    roots = [data] if isinstance(data, str | os.PathLike) else data
    result = run_training(
        override_training_preset(run, changes or {}, steps=steps),
        data=[os.fspath(root) for root in roots],
        out=Path(out),
        start=StartOptions(resume=resume, decisions=decisions or {}, **named),
        dist_context=DistributedContext(device=choose_device(device)),
        workers=workers,
        watched=watched,
        progress=progress,
    )
    assert result is not None  # rank 0 returns a result
    return result
