"""One training run, from a dataset to weights, figures and a sheet: joins the parts."""

import dataclasses
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import torch

from model.renderformer import count_parameters
from model.sky.known import require_known, shining
from storage.dataset.mixed_data import open_mixture
from storage.dataset.training_data import TrainingData
from storage.errors import TrilightError
from train.beginning import beginning, begun
from train.data.arrival import looks_up_itself, step_scenes
from train.data.scenes import TrainingScene, training_scene
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable, first_samples
from train.data.workers import fitting_workers, this_machine
from train.evaluation.judge import Judge
from train.evaluation.rivals import median_picture
from train.folder import RunFolder, claim_run
from train.loop.checkpoints import saved_steps
from train.loop.crew import Crew
from train.loop.recorder import Recorder
from train.loop.state import TrainState
from train.loop.trainer import Trainer, scene_flops
from train.loss.lpips import load_lpips
from train.loss.objective import Objective
from train.progress import TrainProgress
from train.result import TrainResult, finished
from train.settings import TrainSettings
from train.start import Start
from train.watching.notes import add_note
from train.watching.settings import WatchSettings
from train.watching.weights_and_biases import require_wandb

MEDIAN_SCENES = 256
"""Training scenes of which the median picture is taken; more would not move it."""

VALIDATION = "validation"
"""Split of the scenes that a run is judged on and never shown."""

UNJUDGED = (
    "the data has no validation split, so the network is not judged on scenes that it has never "
    "seen, and there is no sheet; a dataset of more scenes has one"
)


def train_run(
    settings: TrainSettings,
    *,
    data: Sequence[str],
    out: Path,
    start: Start | None = None,
    crew: Crew | None = None,
    workers: int | None = None,
    watched: WatchSettings | None = None,
    progress: TrainProgress | None = None,
) -> TrainResult | None:
    """Train a network and judge it.

    Args:
        settings: the run; `train.runs.named_run` returns those that have a name.
        data: root of a dataset, or of several that are mixed (storage.dataset.mixed_data), or a
            list of shards (storage.dataset.training_data), with a train split; without a validation
            split nothing is judged.
        out: folder of the run (train.folder), new unless it resumes.
        start: how it begins; anew unless said.
        crew: the processes that train together (loop.crew.join_crew); this one unless said.
        workers: threads that read and decode samples; as many as fit unless said. The weights do
            not depend on them.
        watched: how the run is watched, which the weights do not depend on either.
        progress: receives the events of the run, in the first process.

    Returns:
        What the run has to show; None in all processes but the first.

    Raises:
        TrilightError: no dataset, an empty split, a damaged shard, a bad target, a resolution or
            number of views that the data does not have, a folder that already holds a run, a
            checkpoint that is missing or of another run, LPIPS without its weights, a start that
            went dead, too little memory, or a signal that asked to stop.
    """
    require_wandb((watched or WatchSettings()).wandb)
    crew, folder = crew or Crew(device=torch.device("cpu")), RunFolder(out)
    with claim_run(folder, crew):
        return _train(
            settings,
            data=data,
            folder=folder,
            start=start or Start(),
            crew=crew,
            workers=workers,
            watched=watched or WatchSettings(),
            progress=progress if progress is not None and crew.is_first else TrainProgress(),
        )


def _train(
    settings: TrainSettings,
    *,
    data: Sequence[str],
    folder: RunFolder,
    start: Start,
    crew: Crew,
    workers: int | None,
    watched: WatchSettings,
    progress: TrainProgress,
) -> TrainResult | None:
    """Train and judge in a folder that is claimed; as `train_run`."""
    began, opened = time.monotonic(), open_mixture(data)
    start = _decided(start, folder, crew)
    early = _EarlyNotes(progress)
    for note in (*opened.notes, *(() if VALIDATION in opened.splits else (UNJUDGED,))):
        early.noted(note)
    workers = _fitting_workers(settings, crew, early) if workers is None else workers
    plan = beginning(settings, folder, opened.digest, start, crew, early)
    settings = plan.settings
    lpips = crew.once_a_machine(partial(load_lpips, start.lpips))
    objective = Objective(settings.loss, lpips).to(crew.device)
    _check_data(opened, settings)
    state = begun(plan, folder, opened, crew, early)
    judge = _make_judge(opened, settings, state.unusable) if crew.is_first else None
    recorder = None
    if crew.is_first:
        recorder = _recorder(state, settings, folder, judge, progress, watched)
        _note_beginning(folder, state, crew, early.texts, resumed=start.resume)
    trainer = Trainer(
        state=state,
        settings=settings,
        objective=objective,
        crew=crew,
        folder=folder,
        data_digest=opened.digest,
        recorder=recorder,
        watched=watched,
    )
    with closing(_batches(opened, settings, state, crew, workers)) as batches:
        cost, most = partial(scene_flops, settings), settings.scenes_per_pass
        with closing(step_scenes(batches, cost, most, crew.device)) as steps:
            trainer.run(steps)
    if recorder is None:
        return None
    recorder.close()
    return finished(state, settings, folder, opened, judge, time.monotonic() - began)


def _fitting_workers(settings: TrainSettings, crew: Crew, progress: TrainProgress) -> int:
    """Return how many threads decode, and say why."""
    fitting = fitting_workers(
        this_machine(),
        settings,
        on_card=crew.device.type == "cuda",
        busy_threads=torch.get_num_threads(),
    )
    progress.noted(fitting.because)
    return fitting.threads


def _decided(start: Start, folder: RunFolder, crew: Crew) -> Start:
    """Return how all processes begin, where one may begin or resume.

    All must ask, since torchrun counts its restarts for each machine apart, and a network file
    system shows a file to one machine before another.
    """
    found = crew.any(start.restartable and bool(saved_steps(folder.checkpoints)))
    return dataclasses.replace(start, resume=start.resume or found, restartable=False)


def _batches(
    data: TrainingData, settings: TrainSettings, state: TrainState, crew: Crew, workers: int
) -> Generator[list[TrainingScene], None, None]:
    """Return the scenes of this process for each step from the state's on."""
    asked = dataclasses.replace(
        stream_settings(settings), looked_up=not looks_up_itself(crew.device)
    )
    return stream_batches(
        data.split("train"),
        asked,
        state.step,
        share=crew.share,
        workers=workers,
        unusable=state.unusable,
        mixture=state.mixture,
    )


class _EarlyNotes(TrainProgress):
    """Passes notes on, and keeps them until the folder of the run is known to be its own."""

    def __init__(self, progress: TrainProgress) -> None:
        self._progress = progress
        self.texts: list[str] = []

    def noted(self, text: str) -> None:
        self._progress.noted(text)
        self.texts.append(text)


def _note_beginning(
    folder: RunFolder,
    state: TrainState,
    crew: Crew,
    notes: Sequence[str],
    *,
    resumed: bool,
) -> None:
    """Write down that a call of the trainer began or went on, and what it said until now."""
    how = "went on" if resumed else "began"
    many = "process" if crew.world_size == 1 else "processes"
    for text in (f"{how} on {crew.device}, {crew.world_size} {many}", *notes):
        add_note(folder.notes, state.step, text)


def stream_settings(settings: TrainSettings) -> StreamSettings:
    """Return what a run asks of the stream of its scenes."""
    return StreamSettings(
        seed=settings.seed,
        window=settings.shuffle_shards,
        batch_size=settings.scenes_per_step,
        resolution=settings.resolution,
        views_per_scene=settings.views_per_scene,
        most_triangles=settings.most_triangles,
        augmentation=settings.augmentation,
        network=settings.model,
    )


def _check_data(data: TrainingData, settings: TrainSettings) -> None:
    """Refuse data that lacks views or lights before any work; damage is counted when it is read."""
    shards = data.split("train")
    lights_apart = settings.augmentation.light_mix > 1
    num_views = [source.num_views for source in data.sources]
    if None in num_views or lights_apart:
        unusable = Unusable(settings.most_unusable)
        samples = list(first_samples(shards, len(data.sources), unusable))
        num_views = [sample.scene.num_views for sample in samples]
        for sample in samples:
            training_scene(sample, settings.resolution, lights_apart=lights_apart)
    fewest = min(count for count in num_views if count is not None)
    if settings.views_per_scene > fewest:
        raise TrilightError(
            f"views_per_scene is {settings.views_per_scene}, but scenes of {data.shown} "
            f"have {fewest} views; expected at most that many."
        )


def _make_judge(data: TrainingData, settings: TrainSettings, unusable: Unusable) -> Judge | None:
    if VALIDATION not in data.splits:
        return None
    training = [
        training_scene(sample, settings.resolution).target_VRR3.numpy()
        for sample in first_samples(data.split("train"), MEDIAN_SCENES, unusable)
    ]
    # no damage is allowed here: a score over fewer scenes would be another score
    samples = list(first_samples(data.split(VALIDATION), settings.validation_scenes, Unusable(0)))
    for sample in samples:  # before any step, not at the first validation
        require_known(shining(sample.scene.environment), settings.model)
    return Judge(samples, settings.resolution, median_picture(training))


def _recorder(
    state: TrainState,
    settings: TrainSettings,
    folder: RunFolder,
    judge: Judge | None,
    progress: TrainProgress,
    watched: WatchSettings,
) -> Recorder:
    progress.begin(
        step=state.step,
        num_steps=settings.num_steps,
        num_parameters=count_parameters(state.model),
        median_scores=judge.median_scores if judge else None,
    )
    return Recorder(folder, settings, judge, progress, first_step=state.step, wandb=watched.wandb)
