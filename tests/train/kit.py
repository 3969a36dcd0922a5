"""A run that takes seconds, its steps and its stream alone, and who listens to it."""

import dataclasses
import itertools
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from model.config import ModelConfig
from model.open import path_of_step, saved_steps
from model.renderformer import RenderFormer
from model.scene_tensors import SceneTensors
from storage.dataset.dataset import Dataset
from storage.dataset.training_data import TrainingData, open_training_data
from tests.train.toy import toy_sample
from train.data.bad_samples import BadSampleCounter
from train.data.buckets import TrainingBatch, collate_batch
from train.data.loader import load_batches
from train.data.order import RankSlice
from train.data.scenes import TrainingScene, training_scene
from train.evaluation.evaluate import EvalConfig
from train.folder import read_rows
from train.loop.distributed import DistributedContext
from train.loop.step import Stepper, StepReport
from train.loop.train_state import TrainState, new_state
from train.loss.training_loss import TrainingLoss
from train.progress import TrainProgress
from train.resume import StartOptions
from train.run_training import TrainResult, run_training
from train.settings import AugmentationSettings, LossSettings, TrainSettings

CPU = torch.device("cpu")
ALONE = DistributedContext(device=CPU)

TINY_MODEL = ModelConfig(
    width=36,
    num_heads=2,
    encoder_layers=1,
    decoder_layers=1,
    hidden_width=48,
    num_registers=1,
    rope_num_freqs=1,
    rope_max_freq=5.0,
    head="linear",
)


def tiny_run(**changes: object) -> TrainSettings:
    settings = TrainSettings(
        run="tiny",
        model=TINY_MODEL,
        resolution=16,
        loss=LossSettings(perceptual="none"),
        augmentation=AugmentationSettings(mirror=True, channels=True, vertex_order=True),
        num_steps=12,
        scenes_per_step=3,
        views_per_scene=2,
        learning_rate=2e-3,
        warmup_steps=2,
        log_every=2,
        validate_every=4,
        checkpoint_every=4,
    )
    return dataclasses.replace(settings, **changes)  # type: ignore[arg-type]


def plain_run(**changes: object) -> TrainSettings:
    """Return a run whose scenes are as they are stored."""
    return tiny_run(**{"augmentation": AugmentationSettings(), **changes})


class Killed(BaseException):
    """Stands for a power cut: nothing is saved on the way out."""


class Heard(TrainProgress):
    """Keeps what a run says, and ends it at a step as a power cut would."""

    def __init__(self, *, killed_at: int | None = None) -> None:
        self.killed_at = killed_at
        self.notes: list[str] = []
        self.progress: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def begin(self, *, step: int, num_steps: int, **_: Any) -> None:
        self.progress.append(f"begin {step}/{num_steps}")

    def advance(self, *, step: int, **_: Any) -> None:
        self.progress.append(f"step {step}")
        if step == self.killed_at:
            raise Killed

    def report_validation(self, *, step: int, **_: Any) -> None:
        self.progress.append(f"validated {step}")


def trained(
    settings: TrainSettings, data: Dataset | Sequence[str], out: Path, **rest: Any
) -> TrainResult:
    """Run to the end in this process; `rest` is of `StartOptions` or `run_training`."""
    places = [str(data.folder.root)] if isinstance(data, Dataset) else data
    options = {field.name for field in dataclasses.fields(StartOptions)} & rest.keys()
    start = StartOptions(**{name: rest.pop(name) for name in options})
    result = run_training(settings, data=places, out=out, start=start, **rest)
    assert result is not None
    return result


TIMINGS = {"views_per_s", "data_wait_share", "flops_per_s", "peak_share", "time_s", "memory_mb"}
TIMINGS |= {"own_s"}


def require_same_run(out: Path, whole: Path) -> None:
    """Compare what two finished runs of one training have written, but for clocks and memory."""
    last = path_of_step(Path("checkpoints"), saved_steps(whole / "checkpoints")[-1])
    for name in ("model.safetensors", last, "validation_sheet.png"):
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    ours, theirs = (
        [
            {name: value for name, value in row.items() if name not in TIMINGS}
            for row in read_rows(folder / "metrics.jsonl")
        ]
        for folder in (out, whole)
    )
    assert ours == theirs


def apart(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    """Return how far the weights of two networks are apart, root of the sum of squares."""
    return sum(float((one[name] - other[name]).square().sum()) for name in one) ** 0.5


def require_resumed_to_the_bit(
    run: TrainSettings, data: Dataset | Sequence[str], out: Path, **resumed: Any
) -> None:
    """Train, take the end of the run away, and resume: the weights are those that were there."""
    folder = trained(run, data, out).folder
    weights = folder.weights.read_bytes()
    path_of_step(folder.checkpoints, run.num_steps).unlink()
    folder.weights.unlink()
    again = trained(run, data, out, resume=True, **resumed)
    assert again.folder.weights.read_bytes() == weights


def eval_config(data: Dataset, network: RenderFormer | None = None, **changes: Any) -> EvalConfig:
    """Return an evaluation of all of a validation split, by default of an untrained network."""
    config = EvalConfig(
        network=network or new_state(tiny_run()).model,
        shards=open_training_data([str(data.folder.root)]).split("validation"),
        resolution=16,
        baselines=None,
        lpips=None,
        most_scenes=99,
    )
    return dataclasses.replace(config, **changes)


def toy_batch(*indices: int) -> TrainingBatch:
    """Return toy scenes of 16 pixels, by their numbers, as one batch."""
    return collate_batch([training_scene(toy_sample(index), 16) for index in indices])


def bare_scene(tensors: SceneTensors) -> TrainingScene:
    """Return a training scene of one view whose picture does not matter."""
    return TrainingScene(
        key="",
        tensors=tensors,
        target_VRR3=torch.zeros(1, 4, 4, 3),
        noise_V=torch.zeros(1),
        light_T=torch.zeros(tensors.num_triangles, dtype=torch.int64),
    )


def stepper(state: TrainState) -> Stepper:
    return Stepper(state, TrainingLoss(state.settings.loss, None), ALONE)


def take_step(state: TrainState, batches: list[TrainingBatch], rate: float = 3e-3) -> StepReport:
    report = stepper(state).step(batches, rate)
    state.step += 1
    return report


def stream(
    data: TrainingData | Dataset,
    settings: TrainSettings,
    *,
    first: int = 0,
    rank: int = 0,
    world_size: int = 1,
    **changes: Any,
) -> closing[Any]:
    """Return the batches first, first + 1, ... of the training split, to be closed."""
    opened = open_training_data([str(data.folder.root)]) if isinstance(data, Dataset) else data
    batches = load_batches(
        opened.split("train"),
        settings,
        first,
        rank_slice=RankSlice(rank=rank, world_size=world_size),
        **{"workers": 1, "unusable": BadSampleCounter(0), **changes},
    )
    return closing(batches)


def take(
    data: TrainingData | Dataset, settings: TrainSettings, count: int, **changes: Any
) -> list[list[TrainingScene]]:
    with stream(data, settings, **changes) as batches:
        return list(itertools.islice(batches, count))


def keys_of(batches: Sequence[Sequence[TrainingScene]]) -> list[list[str]]:
    return [[scene.key for scene in batch] for batch in batches]


def flip_a_bit(path: Path) -> None:
    """Damage a file in its middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
