"""The small trainings of the table: dataset size x model x one change x seed."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from model.config import ModelConfig
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.settings import settings_record
from train.data.augmentation import AugmentationSettings
from train.loss.settings import LossSettings
from train.runs import smoke
from train.settings import TrainSettings

BASELINE = "ours"

SCENES = (60, 240, 960)
SEEDS = (0, 1)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What differs between a small machine and a large one."""

    sizes: Mapping[str, ModelConfig]
    """Networks by name."""
    resolution: int
    """Pixels across."""
    num_steps: int
    """Of every job: all see equally many views."""
    scenes_per_step: int
    """Of every job."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One training."""

    plan: str
    """Name of the plan."""
    scenes: int
    """Training scenes, at least; whole shards are taken."""
    size: str
    """Name of the network."""
    change: str
    """What is different from the baseline."""
    seed: int
    """Of weights, order and augmentation."""

    @property
    def name(self) -> str:
        """Tells it from all others."""
        return f"{self.plan}-{self.scenes}-{self.size}-{self.change}-{self.seed}"

    def settings(self) -> TrainSettings:
        """Return the run."""
        plan = PLANS[self.plan]
        base = dataclasses.replace(
            smoke(),
            run="table",
            model=plan.sizes[self.size],
            resolution=plan.resolution,
            num_steps=plan.num_steps,
            learning_rate=1e-3,  # 1.5e-3, of the smoke run, jumps about with so few views a step
            scenes_per_step=plan.scenes_per_step,
            views_per_scene=2,
            warmup_steps=plan.num_steps // 20,
            validate_every=plan.num_steps // 10,
            checkpoint_every=plan.num_steps // 10,
            checkpoints_kept=1,
            seed=self.seed,
        )
        return CHANGES[self.change](base)

    def digest(self) -> str:
        """Return what a result is known by: all settings, those at their default unsaid."""
        return sha256_hex(
            canonical_json({"augmentation": {}, **settings_record(self.settings(), stated=True)})
        )


def _network(width: int, layers: int) -> ModelConfig:
    """Return a network with heads of 64 and a linear head."""
    return dataclasses.replace(
        smoke().model,
        width=width,
        num_heads=width // 64,
        hidden_width=3 * width,
        encoder_layers=layers,
        decoder_layers=layers,
    )


PLANS: Mapping[str, Plan] = {
    "cpu": Plan(
        sizes={"small": _network(64, 2), "large": _network(128, 2)},
        resolution=64,
        num_steps=400,
        scenes_per_step=4,
    ),
    "gpu": Plan(
        sizes={"small": _network(256, 4), "large": _network(512, 8)},
        resolution=128,
        num_steps=8_000,
        scenes_per_step=32,
    ),
}
"""`cpu`: every job below 15 minutes on two cores."""


def _with(settings: TrainSettings, **changes: object) -> TrainSettings:
    return dataclasses.replace(settings, **changes)  # type: ignore[arg-type]


def _half(settings: TrainSettings) -> TrainSettings:
    """Return half the steps, all of the schedule."""
    halved = ("num_steps", "warmup_steps", "log_every", "validate_every", "checkpoint_every")
    return _with(settings, **{name: getattr(settings, name) // 2 for name in halved})


CHANGES: Mapping[str, Callable[[TrainSettings], TrainSettings]] = {
    BASELINE: lambda base: base,
    "no-symmetry": lambda base: _with(base, augmentation=AugmentationSettings()),
    "paper-schedule": lambda base: _with(
        base,
        learning_rate=1e-4,
        warmup_steps=round(0.016 * base.num_steps),  # 8k of 500k
        final_rate_share=0.01,
        betas=(0.9, 0.999),
    ),
    "rotation": lambda base: _with(
        base, augmentation=dataclasses.replace(base.augmentation, rotation="uniform")
    ),
    "light-scale": lambda base: _with(
        base, augmentation=dataclasses.replace(base.augmentation, light_scale=2.0)
    ),
    "muon": lambda base: _with(base, muon_rate=3.0),
    "muon-half": lambda base: _half(_with(base, muon_rate=3.0)),
    "ema": lambda base: _with(base, ema_decay=0.995),
    "ms-ssim": lambda base: _with(base, loss=LossSettings(perceptual="ms_ssim")),
    "noise-weights": lambda base: _with(
        base, loss=LossSettings(perceptual="none", noise_half=0.01)
    ),
}
"""One change at a time, and one of them in half the steps. The first three are the least."""


def all_jobs(plan: str) -> list[Job]:
    """Return the jobs of a plan: whole changes in turn, so that a budget ends between two."""
    if plan not in PLANS:
        raise TrilightError(f"plan {plan!r}: no such plan; expected {' or '.join(PLANS)}.")
    return [
        Job(plan=plan, scenes=scenes, size=size, change=change, seed=seed)
        for change in CHANGES
        for seed in SEEDS
        for size in PLANS[plan].sizes
        for scenes in SCENES
    ]
