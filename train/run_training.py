"""One training run, started or resumed, from a dataset to weights, scores and a sheet."""

import dataclasses
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from model.open import find_checkpoint, open_network, read_header, saved_steps
from model.renderformer import count_parameters
from model.scene_tensors import lit_sky, require_known_sky
from model.weights import TrainedRange, decode_config, encode_weights
from storage.atomic import write_atomically
from storage.dataset.training_data import TrainingData, open_training_data
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.extensions import extension_digests
from storage.records.safe_read import read_plain
from storage.typed_json import read_json
from train.data.bad_samples import BadSampleCounter, first_samples
from train.data.buckets import step_scenes
from train.data.loader import choose_workers, load_batches
from train.data.order import RECORD, plan_mixture
from train.data.scenes import training_scene
from train.evaluation.metrics import Lead
from train.evaluation.sheet import write_picture
from train.evaluation.validation import Judge, draw_validation_sheet, median_picture
from train.folder import RunFolder, add_note, claim_run, copy_rows, pretty_json, read_rows
from train.loop.checkpoints import (
    newest_checkpoint,
    read_checkpoint,
    restore_state,
    save_checkpoint,
)
from train.loop.distributed import DistributedContext
from train.loop.optimizer import choose_muon_precision
from train.loop.recorder import Recorder, require_wandb
from train.loop.train_state import TrainState, new_state
from train.loop.trainer import Trainer, scene_flops
from train.loss.training_loss import TrainingLoss, load_lpips
from train.progress import TrainProgress
from train.resume import Event, StartOptions, StartPlan, plan_resume
from train.settings import TrainSettings, WatchSettings, stored_settings

LOSS_SHARE = 20
"""Divisor of the log's rows: the start and end losses average the first and last twentieth."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Result of a finished run."""

    folder: RunFolder
    """Folder that holds all files of the run."""
    num_parameters: int
    """Numbers in the network's weights."""
    num_steps: int
    """Steps done, including skipped ones."""
    skipped_steps: int
    """Steps that were not finite and changed nothing."""
    loss_at_start: float
    """Mean training loss over the first twentieth of the run."""
    loss_at_end: float
    """The same over the last twentieth."""
    scores: dict[str, float] | None
    """The network on the validation split (evaluation.validation); None where the data has none."""
    median_scores: dict[str, float] | None
    """The median picture of the training views on the same split."""
    lead: Lead | None
    """Advantage of the network over the median picture."""
    unusable: tuple[str, ...]
    """Error messages of the damaged data that this call left out."""
    history: tuple[Event, ...]
    """Origin, decisions and execution changes of the run, oldest first."""
    seconds: float
    """Wall time of this call, from opening the data to writing the sheet."""

    @property
    def beats_median(self) -> bool | None:
        """True if the network beats the median picture by more than two standard errors."""
        return None if self.lead is None else self.lead.is_sure


def finish_run(
    state: TrainState,
    folder: RunFolder,
    data: TrainingData,
    recorder: Recorder,
    seconds: float,
) -> TrainResult:
    """End the recording, evaluate the network, and write its weights, sheet and summary."""
    recorder.close()
    judge = recorder.judge
    settings = state.settings
    trained = TrainedRange(max_triangles=data.max_triangles, resolution=settings.resolution)
    write_atomically(folder.weights, encode_weights(state.eval_model, trained))
    losses = [row["loss"] for row in read_rows(folder.metrics) if row.get("loss") is not None]
    count = max(len(losses) // LOSS_SHARE, 1)
    validation = None
    if judge is not None:
        validation = recorder.validation or judge.judge(state.eval_model)
        write_picture(folder.sheet, draw_validation_sheet(settings, judge, validation, state.step))
    result = TrainResult(
        folder=folder,
        num_parameters=count_parameters(state.model),
        num_steps=state.step,
        skipped_steps=state.skipped_steps,
        loss_at_start=sum(losses[:count]) / count,
        loss_at_end=sum(losses[-count:]) / count,
        scores=validation.scores if validation else None,
        median_scores=judge.median_scores if judge else None,
        lead=validation.lead if validation else None,
        unusable=tuple(state.bad_samples.messages),
        history=state.history,
        seconds=seconds,
    )
    record = dataclasses.asdict(result) | {"beats_median": result.beats_median}
    del record["folder"]
    write_atomically(folder.summary, pretty_json(record))
    return result


MEDIAN_SCENES = 256
"""Number of training scenes for the median picture; more would not change it."""

VALIDATION = "validation"
"""Split of the scenes that a run is evaluated on and never trained on."""

RESTARTS = "TORCHELASTIC_RESTART_COUNT"
"""Environment variable in which torchrun counts the restarts of its processes."""

UNJUDGED = (
    "the data has no validation split, so the network is not judged on scenes that it has never "
    "seen, and there is no sheet; a dataset of more scenes has one"
)


def run_training(
    settings: TrainSettings,
    *,
    data: Sequence[str],
    out: Path,
    start: StartOptions | None = None,
    dist_context: DistributedContext | None = None,
    workers: int | None = None,
    watched: WatchSettings | None = None,
    progress: TrainProgress | None = None,
) -> TrainResult | None:
    """Train a network and evaluate it.

    Args:
        settings: the run; `train.presets.training_preset` returns those that have a name.
        data: root of a dataset, or of several that are mixed (storage.dataset.training_data), or a
            list of shards (storage.dataset.training_data), with a train split; without a validation
            split nothing is evaluated.
        out: folder of the run (train.folder), new unless it resumes.
        start: how the run starts; by default new, with random weights.
        dist_context: processes of a distributed run (`join_processes`); by default this one alone.
        workers: threads that read and decode samples; by default as many as fit. The weights do
            not depend on them.
        watched: settings of the monitoring, on which the weights do not depend either.
        progress: receives the events of the run, in the first process.

    Returns:
        The result of the run; None in all processes but the first.

    Raises:
        TrilightError: no dataset, an empty split, a damaged shard, a bad target, a resolution or
            number of views that the data does not have, a folder that already holds a run, a
            checkpoint that is missing or of another run, LPIPS without its weights, a start that
            went dead, too little memory, or a signal that asked to stop.
    """
    watched = watched or WatchSettings()
    require_wandb(watched.wandb)
    dist_context = dist_context or DistributedContext(device=torch.device("cpu"))
    if progress is None or not dist_context.is_first:
        progress = TrainProgress()
    folder = RunFolder(out)
    start = start or StartOptions()
    with claim_run(folder, dist_context):
        return _train(settings, data, folder, start, dist_context, workers, watched, progress)


def _train(
    settings: TrainSettings,
    data: Sequence[str],
    folder: RunFolder,
    start: StartOptions,
    dist_context: DistributedContext,
    workers: int | None,
    watched: WatchSettings,
    progress: TrainProgress,
) -> TrainResult | None:
    """Train and evaluate in a folder that is locked; arguments as in `run_training`."""
    began = time.monotonic()
    dataset = open_training_data(data, may_mix=True)
    notes: list[str] = []

    def note(text: str) -> None:
        progress.note(text)
        notes.append(text)  # until the run's folder may be written

    for text in (*dataset.notes, *(() if VALIDATION in dataset.splits else (UNJUDGED,))):
        note(text)
    if workers is None:
        on_gpu = dist_context.device.type == "cuda"
        threads = torch.get_num_threads()
        workers, reason = choose_workers(settings, on_gpu=on_gpu, busy_threads=threads)
        note(reason)
    plan = plan_start(settings, folder, dataset.digest, start, dist_context, note)
    settings = plan.settings
    lpips = dist_context.run_once_per_machine(partial(load_lpips, start.lpips))
    objective = TrainingLoss(settings.loss, lpips).to(dist_context.device)
    _check_data(dataset, settings)
    state = init_or_resume_state(plan, folder, dataset, dist_context, note)
    recorder = None
    if dist_context.is_first:
        judge = _make_judge(dataset, settings, state.bad_samples)
        recorder = Recorder(folder, judge, progress, state, wandb=watched.wandb)
        how = "began" if plan.checkpoint is None or plan.branch is not None else "went on"
        many = "process" if dist_context.world_size == 1 else "processes"
        where = f"{how} on {dist_context.device}, {dist_context.world_size} {many}"
        for text in (where, *notes):
            add_note(folder.notes, state.step, text)
    trainer = Trainer(state, objective, dist_context, folder, recorder, watched)
    stream = load_batches(
        dataset.split("train"),
        settings,
        state.step,
        rank_slice=dist_context,
        workers=workers,
        unusable=state.bad_samples,
        mixture=state.mixture,
    )
    cost = partial(scene_flops, settings)
    steps = step_scenes(stream, cost, settings.scenes_per_pass, dist_context.device)
    with closing(stream), closing(steps):
        trainer.train(steps)
    if recorder is None:
        return None
    return finish_run(state, folder, dataset, recorder, time.monotonic() - began)


def _check_data(data: TrainingData, settings: TrainSettings) -> None:
    """Raise if the data lacks views or lights; damage is only counted when it is read."""
    shards = data.split("train")
    per_light = settings.augmentation.light_mix > 1
    num_views = [source.num_views for source in data.sources]
    if None in num_views or per_light:
        unusable = BadSampleCounter(settings.most_unusable)
        samples = list(first_samples(shards, len(data.sources), unusable))
        num_views = [sample.scene.num_views for sample in samples]
        for sample in samples:
            training_scene(sample, settings.resolution, lights_apart=per_light)
    fewest = min(count for count in num_views if count is not None)
    if settings.views_per_scene > fewest:
        raise TrilightError(
            f"views_per_scene is {settings.views_per_scene}, but scenes of {data.display_name} "
            f"have {fewest} views; expected at most that many."
        )


def _make_judge(
    data: TrainingData, settings: TrainSettings, unusable: BadSampleCounter
) -> Judge | None:
    if VALIDATION not in data.splits:
        return None
    training = [
        training_scene(sample, settings.resolution).target_VRR3.numpy()
        for sample in first_samples(data.split("train"), MEDIAN_SCENES, unusable)
    ]
    # no damage is allowed here: a score over fewer scenes would be another score
    samples = list(first_samples(data.split(VALIDATION), settings.validation_scenes))
    for sample in samples:  # before any step, not at the first validation
        require_known_sky(lit_sky(sample.scene.environment), settings.model)
    return Judge(samples, settings.resolution, median_picture(training))


def plan_start(
    settings: TrainSettings,
    folder: RunFolder,
    data_digest: str,
    start: StartOptions,
    dist_context: DistributedContext,
    note: Callable[[str], None],
) -> StartPlan:
    """Read what the run starts or resumes with, without writing anything.

    Raises:
        TrilightError: the folder holds a run already, or has none to resume; the checkpoint is
            damaged; or settings or data differ from the run's without a recorded decision.
    """
    # alike in all processes: torchrun counts restarts for each machine separately, and a network
    # file system shows a new file to one machine before another
    restarts = start.restartable or int(os.environ.get(RESTARTS, "0")) > 0
    has_checkpoint = dist_context.any(restarts and bool(saved_steps(folder.checkpoints)))
    start = dataclasses.replace(start, resume=start.resume or has_checkpoint, restartable=False)
    if not start.resume and saved_steps(folder.checkpoints):
        raise TrilightError(
            f"{folder.root}: holds a run already; add --resume to go on with it, or choose "
            "another --out."
        )
    start.check(settings)
    if not start.continues_run:
        source = start.begin_with
        if source is None:
            return StartPlan(settings=settings)
        network = open_network(source)
        settings = dataclasses.replace(settings, model=network.config)
        stored = find_checkpoint(Path(source))
        before = read_header(stored) if stored else {}
        before["sha256"] = sha256_hex(encode_weights(network))
        origin = _origin(0, "weights", before)
        return StartPlan(settings=settings, network=network, history=(origin,))
    branch = None if start.resume or start.branch is None else Path(start.branch)
    if branch is None or branch.is_dir():
        checkpoints = (folder if branch is None else RunFolder(branch)).checkpoints
        checkpoint = newest_checkpoint(checkpoints, dist_context, note)
    else:
        checkpoint = read_checkpoint(branch)
        # the first process soon writes into the folder that all have looked at
        dist_context.barrier()
    if settings.from_weights:
        config = decode_config(checkpoint.header["model"], str(branch or folder.root))
        settings = dataclasses.replace(settings, model=config)
    header = checkpoint.header
    plan = plan_resume(header, settings, data_digest, start.decisions)
    history = plan.history
    if branch is not None:
        history += (_origin(header["step"], "checkpoint", header),)
    return dataclasses.replace(plan, history=history, checkpoint=checkpoint, branch=branch)


def init_or_resume_state(
    plan: StartPlan,
    folder: RunFolder,
    data: TrainingData,
    dist_context: DistributedContext,
    note: Callable[[str], None],
) -> TrainState:
    """Create or restore the state before the run's next step, and record it on disk.

    A run that has just started, branched or changed its meaning is on disk when this returns.

    Raises:
        TrilightError: `data_weights` has another length than the list of datasets.
    """
    device = dist_context.device
    precision = choose_muon_precision(dist_context)
    header = None if plan.checkpoint is None else plan.checkpoint.header
    mixture = plan_mixture(data, plan.settings, header)
    if mixture is not None:
        note(f"the stream mixes {mixture}")
    if plan.checkpoint is None or header is None:
        state = new_state(plan.settings, device, plan.network, precision)
        state.history = plan.history
    else:
        state = restore_state(plan.checkpoint, plan, device, precision)
        for text in plan.notes:
            note(text)
        state.history += tuple(_execution_changes(header, dist_context, state, note))
    state.mixture = mixture
    state.data_digest = data.digest
    if dist_context.is_first:  # on disk, so that a kill before the next checkpoint loses nothing
        if plan.branch is not None:
            root = plan.branch if plan.branch.is_dir() else plan.branch.parent.parent
            copy_rows(RunFolder(root).metrics, folder.metrics, state.step)
        _write_settings(folder, state, dist_context, plan)
        if plan.branch is not None or (header is not None and plan.changes_meaning):
            save_checkpoint(folder.checkpoints, state, world_size=dist_context.world_size)
    return state


def _origin(step: int, name: str, header: Mapping[str, Any]) -> Event:
    """Return the event of what a run started with; it holds no path of the user's machine."""
    settings = header.get("settings", {})
    after = {
        "run": settings.get("run"),
        "step": header.get("step"),
        "sha256": header.get("sha256"),
    }
    return Event(step=step, kind="origin", name=name, after=after)


def _write_settings(
    folder: RunFolder, state: TrainState, dist_context: DistributedContext, plan: StartPlan
) -> None:
    """Write settings.json: current settings, their history, and how the run started."""
    origin = {
        "begun_with_sha256": plan.history[0].after["sha256"] if plan.network else None,
        **({"extensions": extensions} if (extensions := extension_digests("weights")) else {}),
        "versions": {"torch": torch.__version__, "python": platform.python_version()},
        "threads": torch.get_num_threads(),
        "processes": dist_context.world_size,
        "muon_precision": state.optimizer.muon_precision,
    }
    now = {
        "settings": stored_settings(state.settings),
        "data_digest": state.data_digest,
        **({RECORD: dataclasses.asdict(state.mixture)} if state.mixture else {}),
        "history": [dataclasses.asdict(event) for event in state.history],
    }
    stored = dict[str, Any]()
    with suppress(OSError, TrilightError):  # it is missing or damaged
        stored = read_json(read_plain(folder.settings), dict[str, Any], str(folder.settings))
    write_atomically(folder.settings, pretty_json(origin | stored | now))


def _execution_changes(
    header: Mapping[str, Any],
    dist_context: DistributedContext,
    state: TrainState,
    note: Callable[[str], None],
) -> Iterator[Event]:
    """Report and yield changed processes, threads and Muon precision."""
    precision = state.optimizer.muon_precision
    now: dict[str, tuple[Any, Any]] = {
        "processes": (header["world_size"], dist_context.world_size),
        "threads": (header.get("threads"), torch.get_num_threads()),
        # the default is the only one that there was
        "muon_precision": (header.get("muon_precision", "bfloat16"), precision),
    }
    for name, (before, after) in now.items():
        if None in (before, after) or before == after:
            continue
        text = f"{after} {name} instead of {before}: the same to rounding, not to the bit"
        if name == "muon_precision":
            text = (
                f"Muon's products in {after} instead of {before}, which suits the processors here: "
                "the same to the rounding of bfloat16, not to the bit"
            )
        note(f"the run goes on with {text}")
        yield Event(step=state.step, kind="execution", name=name, before=before, after=after)
