"""A run that takes seconds."""

import dataclasses

from model.config import ModelConfig
from train.settings import TrainSettings

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
