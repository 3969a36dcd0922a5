"""One training run, from a dataset to weights, figures and a sheet: joins the parts, no more."""

import dataclasses
import json
import platform
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import torch

from model.renderformer import count_parameters
from model.trained_range import TrainedRange
from model.weights import encode_weights
from storage.atomic import write_atomically
from storage.errors import TrilightError
from storage.training_data import TrainingData, open_training_data
from train.data.order import Share
from train.data.scenes import training_scene
from train.data.splits import first_samples
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable
from train.evaluation.judge import Judge, Judgement, median_picture
from train.evaluation.sheet import SheetView, write_sheet
from train.folder import RunFolder
from train.loop.checkpoint import load_checkpoint
from train.loop.metrics_log import read_rows
from train.loop.state import TrainState, new_state
from train.loop.trainer import Trainer
from train.progress import Progress, Silent
from train.settings import TrainSettings, settings_record

MEDIAN_SCENES = 256
"""Training scenes of which the median picture is taken; more would not move it."""

LOSS_SHARE = 20
"""The loss at start and end is the mean over the first and last 1 / LOSS_SHARE of the log."""

SHEET_SCENES = 8
"""Scenes on the sheet, one view each."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What a finished run has to show."""

    folder: RunFolder
    """Where everything is."""
    num_parameters: int
    """Of the network."""
    num_steps: int
    """Steps done, including skipped ones."""
    skipped_steps: int
    """Steps that were not finite and changed nothing."""
    loss_at_start: float
    """Mean training loss over the first twentieth of the run."""
    loss_at_end: float
    """The same over the last twentieth."""
    scores: dict[str, float]
    """The network on the validation split (evaluation.judge)."""
    median_scores: dict[str, float]
    """The median picture of the training views on the same split."""
    unusable: tuple[str, ...]
    """What was wrong with data that was left out in this call."""
    seconds: float
    """Wall time of this call, from opening the data to writing the sheet."""

    @property
    def beats_median(self) -> bool:
        """Whether the network's log_l1 is below that of the median picture."""
        return self.scores["log_l1"] < self.median_scores["log_l1"]


def train_run(
    settings: TrainSettings,
    *,
    data: Sequence[str],
    out: Path,
    resume: bool = False,
    workers: int = 1,
    progress: Progress | None = None,
) -> TrainResult:
    """Train a network and judge it.

    Args:
        settings: the run; `train.settings.named_run` returns those that have a name.
        data: root of a dataset with a train and a validation split, or a list of shards
            (storage.training_data).
        out: folder of the run (train.folder), new unless `resume`.
        resume: go on from the folder's checkpoint; the weights come out the same to the bit on the
            CPU, for the same number of threads. A finished run is judged again.
        workers: threads that read and decode samples; the weights do not depend on them.
        progress: is told how it goes.

    Raises:
        TrilightError: no dataset, an empty split, a damaged shard, a bad target, a resolution or
            number of views that the data does not have, a folder that already holds a run, a
            checkpoint that is missing or of another run, or a signal that asked to stop.
    """
    began = time.monotonic()
    progress = progress or Silent()
    opened, folder = open_training_data(data), RunFolder(out)
    for note in opened.notes:
        progress.noted(note)
    _check_data(opened, settings)
    state = _begin(settings, folder, opened, resume)
    judge = _make_judge(opened, settings, state.unusable)
    progress.begin(
        step=state.step,
        num_steps=settings.num_steps,
        num_parameters=count_parameters(state.model),
        median_scores=judge.median_scores,
    )
    trainer = Trainer(
        state=state,
        settings=settings,
        folder=folder,
        data_digest=opened.digest,
        judge=judge,
        progress=progress,
    )
    batches = stream_batches(
        opened.split("train"),
        StreamSettings(
            seed=settings.seed,
            window=settings.shuffle_shards,
            batch_size=settings.scenes_per_step,
            resolution=settings.resolution,
            views_per_scene=settings.views_per_scene,
        ),
        state.step,
        share=Share(),
        workers=workers,
        unusable=state.unusable,
    )
    with closing(batches):
        trainer.run(batches)
    return _finish(state, settings, folder, opened, judge, began)


def _check_data(data: TrainingData, settings: TrainSettings) -> None:
    """Find out before any work what the data cannot give; damage is counted when it is used."""
    for split in ("train", "validation"):
        data.split(split)
    num_views = data.num_views
    if num_views is None:
        (sample,) = first_samples(data.split("train"), 1, Unusable(settings.most_unusable))
        num_views = sample.scene.num_views
    if settings.views_per_scene > num_views:
        raise TrilightError(
            f"views_per_scene is {settings.views_per_scene}, but scenes of {data.shown} "
            f"have {num_views} views; expected at most that many."
        )


def _begin(
    settings: TrainSettings, folder: RunFolder, data: TrainingData, resume: bool
) -> TrainState:
    if resume:
        return load_checkpoint(folder.checkpoint, settings, data.digest)
    if folder.checkpoint.exists():
        raise TrilightError(
            f"{folder.root}: holds a run already; add --resume to go on with it, or choose "
            "another --out."
        )
    record = {
        "settings": settings_record(settings),
        "data_digest": data.digest,
        "versions": {"torch": torch.__version__, "python": platform.python_version()},
        "threads": torch.get_num_threads(),
    }
    write_atomically(folder.settings, _pretty_json(record))
    return new_state(settings)


def _make_judge(data: TrainingData, settings: TrainSettings, unusable: Unusable) -> Judge:
    training = [
        training_scene(sample, settings.resolution)
        for sample in first_samples(data.split("train"), MEDIAN_SCENES, unusable)
    ]
    # what is judged by must be whole: a score over fewer scenes would be another score
    samples = list(first_samples(data.split("validation"), settings.validation_scenes, Unusable(0)))
    return Judge(samples, settings.resolution, median_picture(training))


def _finish(
    state: TrainState,
    settings: TrainSettings,
    folder: RunFolder,
    data: TrainingData,
    judge: Judge,
    began: float,
) -> TrainResult:
    most = data.max_triangles
    trained = None if most is None else TrainedRange(max_triangles=most)
    write_atomically(folder.weights, encode_weights(state.model, trained))
    judgement = judge.judge(state.model)
    loss_at_start, loss_at_end = _losses(folder, settings)
    _write_sheet(folder, settings, judge, judgement)
    result = TrainResult(
        folder=folder,
        num_parameters=count_parameters(state.model),
        num_steps=state.step,
        skipped_steps=state.skipped_steps,
        loss_at_start=loss_at_start,
        loss_at_end=loss_at_end,
        scores=judgement.scores,
        median_scores=judge.median_scores,
        unusable=tuple(state.unusable.messages),
        seconds=time.monotonic() - began,
    )
    record = dataclasses.asdict(result) | {"beats_median": result.beats_median}
    del record["folder"]
    write_atomically(folder.summary, _pretty_json(record))
    return result


def _losses(folder: RunFolder, settings: TrainSettings) -> tuple[float, float]:
    """Return the mean training loss of the first and of the last rows of the log."""
    rows = [row["loss"] for row in read_rows(folder.metrics) if row.get("loss") is not None]
    count = max(len(rows) // LOSS_SHARE, 1)
    return sum(rows[:count]) / count, sum(rows[-count:]) / count


def _write_sheet(
    folder: RunFolder, settings: TrainSettings, judge: Judge, judgement: Judgement
) -> None:
    views, at = [], 0
    for judged, pictures in zip(judge.scenes, judgement.pictures, strict=True):
        score, median = judgement.views[at], judge.median_views[at]
        at += len(pictures)
        views.append(
            SheetView(
                name=f"scene {judged.scene.key}, view 0",
                scores=(
                    f"log L1 {score.log_l1:.4f} (median picture {median.log_l1:.4f}), "
                    f"{score.psnr_log_db:.1f} dB log, {score.psnr_linear_db:.1f} dB linear"
                ),
                target_rgb=judged.target_VRR3[0],
                predicted_rgb=pictures[0],
            )
        )
    title = (
        f"run {settings.run}, {settings.num_steps} steps, {settings.resolution} pixels: "
        f"validation scenes, never trained on",
        f"log L1 {judgement.scores['log_l1']:.4f}, median picture of the training views "
        f"{judge.median_scores['log_l1']:.4f}, "
        f"{judgement.scores['better_than_median']:.0%} of views better than it",
    )
    write_sheet(folder.sheet, views[:SHEET_SCENES], title)


def _pretty_json(record: object) -> bytes:
    return json.dumps(record, indent=1, sort_keys=True).encode() + b"\n"
