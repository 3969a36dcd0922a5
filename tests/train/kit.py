"""A run that takes seconds."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from model.config import ModelConfig
from train.result import TrainResult
from train.run import train_run
from train.settings import AugmentationSettings, LossSettings, TrainSettings
from train.start import Start

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


def trained(
    settings: TrainSettings, data: Sequence[str], out: Path, *, resume: bool = False, **rest: Any
) -> TrainResult:
    """Run to the end in this process."""
    result = train_run(settings, data=data, out=out, start=Start(resume=resume), **rest)
    assert result is not None
    return result
