"""Training runs: one frozen description, and one function per named run.

A run is a Python function that returns the whole description; the command line only picks one and
may replace fields. What is not here cannot be changed.
"""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from model.config import ModelConfig
from model.config import smoke as smoke_model
from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True)
class TrainSettings:
    """Everything that decides which weights come out, beside the data."""

    run: str
    """Name of the run."""
    model: ModelConfig
    """The network."""
    resolution: int
    """Pixels across the training pictures: a divisor of the data's, a multiple of the bundle's."""
    seed: int = 0
    """Of initial weights, order and augmentation."""
    num_steps: int
    """Updates of the weights; the learning rate ends its cosine at the last one."""
    scenes_per_step: int
    """Scenes whose gradients are averaged into one update."""
    views_per_scene: int
    """Views of each, drawn anew at every visit; at most as many as the data holds."""
    learning_rate: float
    """Peak learning rate of AdamW."""
    warmup_steps: int
    """Steps of linear rise to the peak."""
    final_rate_share: float = 0.05
    """Learning rate at the last step, as a share of the peak."""
    weight_decay: float = 0.01
    """Decoupled decay of every weight (Loshchilov and Hutter 2019)."""
    betas: tuple[float, float] = (0.9, 0.99)
    """AdamW's memories."""
    grad_clip: float = 1.0
    """Longest gradient that is followed; a longer one is shortened to this."""
    recompute_activations: bool = False
    """Trade a third more time for memory: see RenderFormer.recompute_activations."""
    shuffle_shards: int = 4
    """Shards that are open at the same time, among whose samples is shuffled."""
    most_unusable: int = 0
    """Damaged samples that may be replaced by others; at 0 the first one ends the run."""
    log_every: int = 10
    """Steps between rows of metrics.jsonl."""
    validate_every: int
    """Steps between validations."""
    checkpoint_every: int
    """Steps between checkpoints."""
    validation_scenes: int = 64
    """Most scenes of the validation split that are judged."""

    def __post_init__(self) -> None:
        patch_px = self.model.patch_px
        if self.resolution < patch_px or self.resolution % patch_px:
            _wrong("resolution", self.resolution, f"a multiple of {patch_px}")
        for name in (
            "num_steps",
            "scenes_per_step",
            "views_per_scene",
            "shuffle_shards",
            "log_every",
            "validate_every",
            "checkpoint_every",
            "validation_scenes",
        ):
            if getattr(self, name) < 1:
                _wrong(name, getattr(self, name), "at least 1")
        for name in ("validate_every", "checkpoint_every"):
            if getattr(self, name) % self.log_every:
                _wrong(name, getattr(self, name), f"a multiple of log_every, {self.log_every}")
        if not 0 <= self.warmup_steps < self.num_steps:
            _wrong("warmup_steps", self.warmup_steps, f"0 to {self.num_steps - 1}")
        for name in ("learning_rate", "grad_clip"):
            if not getattr(self, name) > 0:
                _wrong(name, getattr(self, name), "above 0")
        if self.most_unusable < 0:
            _wrong("most_unusable", self.most_unusable, "at least 0")
        if not self.weight_decay >= 0:
            _wrong("weight_decay", self.weight_decay, "at least 0")


def smoke() -> TrainSettings:
    """Return the run that shows, within five minutes on two CPU cores, that learning happens."""
    return TrainSettings(
        run="smoke",
        model=smoke_model(),
        resolution=64,
        num_steps=360,
        scenes_per_step=4,
        views_per_scene=4,
        learning_rate=1.5e-3,
        warmup_steps=50,
        validate_every=60,
        checkpoint_every=60,
    )


RUNS: dict[str, Callable[[], TrainSettings]] = {"smoke": smoke}
"""Every named run."""


def named_run(name: str) -> TrainSettings:
    """Return the settings of a run; raises TrilightError for an unknown name."""
    if name not in RUNS:
        raise TrilightError(
            f"run {name!r}: no such run; expected one of {', '.join(sorted(RUNS))}."
        )
    return RUNS[name]()


def settings_record(settings: TrainSettings) -> dict[str, Any]:
    """Return the settings as JSON values."""
    record: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    return record


def completed_record(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record of older settings with the fields that came later.

    A field came with a default that is what was done before.
    """
    return _defaults(TrainSettings) | record | {"model": _defaults(ModelConfig) | record["model"]}


def _defaults(settings: type) -> dict[str, Any]:
    known = {f.name: f.default for f in dataclasses.fields(settings)}
    given = {name: value for name, value in known.items() if value is not dataclasses.MISSING}
    record: dict[str, Any] = json.loads(json.dumps(given))
    return record


def _wrong(name: str, got: object, expected: str) -> None:
    raise TrilightError(f"train settings: {name} is {got}; expected {expected}.")
