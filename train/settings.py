"""Settings of a training run, everything that decides the weights, and of its monitoring.

Imports no torch. A run is a Python function that returns all settings (train.presets); the command
line picks one and may replace fields. Fields marked EXECUTION may differ at every resume: the
weights are equal up to rounding, or do not depend on them. All other fields are the meaning of the
run, and change only by a decision that the run records (train.resume).
"""

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Annotated, Any, ClassVar, Literal

from model.config import BaseWidths, ModelConfig
from storage.errors import TrilightError, without_removed
from storage.settings.described import checked, settings_record
from storage.settings.ranges import EXECUTION, Seed, Share, Within

Rotation = Literal["none", "recipe", "uniform"]
"""`recipe`: a rotation vector of three normal numbers, which favors small angles; `uniform`: every
orientation is equally likely."""


@checked("train settings")
class AugmentationSettings:
    """Random augmentation, drawn again at every visit of a scene. The default changes nothing."""

    rotation: Rotation = "none"
    """Distribution of the random rotation of scene and cameras together."""
    translation: Annotated[float, Within(0, 100, unit="meters")] = 0.0
    """Standard deviation per axis of the random translation of scene and cameras together."""
    mirror: bool = False
    """Mirror the scene at half of the visits."""
    channels: bool = False
    """Permute the color channels at random."""
    vertex_order: bool = False
    """Rotate the order of each triangle's vertices at random; its winding stays."""
    light_scale: Annotated[float, Within(1, 1000)] = 1.0
    """Scale all light by one log-uniform factor between 1 / light_scale and light_scale."""
    light_mix: Annotated[float, Within(1, 1000)] = 1.0
    """Scale each light and the sky by a log-uniform factor of its own, 1 / light_mix to light_mix;
    above 1 it needs a dataset with a picture for each light (`per_light`)."""
    withheld_inputs: Share = 0.0
    """Probability that a view lacks an input of the view stage `hits`, drawn for each input;
    other networks have no such inputs."""


Perceptual = Literal["lpips", "ms_ssim", "none"]
"""`lpips` is the recipe's term and needs published weights; `ms_ssim` is another term, without
weights."""


@checked("train settings")
class LossSettings:
    """Terms of the loss (Zeng et al. 2025, section 4) and the weights of views."""

    perceptual: Perceptual
    """Perceptual term of the loss, on tone-mapped pictures."""
    perceptual_weight: Annotated[float, Within(0, 1000)] = 0.05
    """Weight of the perceptual term beside the L1 error of log10(1 + radiance)."""
    noise_half: Annotated[float, Within(0, 10)] = 0.0
    """Root mean square noise of log10(1 + radiance) at which a view has half the weight of a
    noiseless one; 0 gives all views the same weight."""
    REMOVED: ClassVar[dict[str, Any]] = {"lpips_precision": "float32"}
    """Settings of earlier versions, which old files may hold, with the values that meant none."""


Precision = Literal["float32", "bfloat16"]
"""Precision of the network's matrix products. Positions, losses, weights and optimizer state stay
float32."""

Compile = Literal["auto", "yes", "no"]
"""Compilation of layers, head and LPIPS by torch: `auto` compiles on a GPU with Triton, `yes` also
on a CPU, where it takes minutes and gains little."""

Count = Annotated[int, Within(1, 10**9)]
"""Number of steps or of scenes; no run reaches a billion."""

FreeCount = Annotated[Count, EXECUTION]
"""Number of steps or of scenes that decides no weight."""

BelowOne = Within(0, 1, high_open=True)
"""Range of the decay of a running mean; with a decay of 1 the mean would never move."""


@checked("train settings")
class TrainSettings:
    """Everything besides the data that decides the trained weights."""

    run: str
    """Name of the run, as its files and messages show it."""
    model: ModelConfig
    """Sizes of the network, or the name of a preset."""
    from_weights: bool = False
    """Start from given weights (`begin_with`) instead of random ones."""
    data_weights: Annotated[tuple[float, ...], Within(0, 1e9, low_open=True)] = ()
    """Weights of the datasets that are mixed, in their order: the relative numbers of scenes that
    come from each; by default in proportion to their numbers of scenes."""
    resolution: Annotated[int, Within(1, 2048, unit="pixels")]
    """Width of the training pictures in pixels: it divides the dataset's width, and is a multiple
    of the ray bundle's (with Swin windows, of a window's) width."""
    most_triangles: Annotated[int, Within(0, 1_000_000, unit="triangles")] = 0
    """Maximum number of triangles of a scene; larger scenes are unusable (see `most_unusable`); 0
    sets no limit."""
    seed: Seed = 0
    """Seed of the initial weights, the order of samples and the augmentation."""
    loss: LossSettings
    """The loss that training minimises."""
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    """Random augmentation of the training scenes."""
    num_steps: Count
    """Number of steps, each one update of the weights; the schedule of the learning rate ends at
    the last one."""
    scenes_per_step: Annotated[int, Within(1, 65_536, unit="scenes")]
    """Batch size: the number of scenes whose gradients are averaged into one update."""
    views_per_scene: Annotated[int, Within(1, 1000, unit="views")]
    """Views of each scene in a step, drawn again at every visit; at most as many as the dataset
    has."""
    scenes_per_pass: Annotated[int, Within(1, 65_536, unit="scenes"), EXECUTION] = 16
    """Maximum number of scenes in one pass through the network; a step accumulates the gradients of
    its passes."""
    precision: Annotated[Precision, EXECUTION] = "float32"
    """Precision of the network's matrix products."""
    learning_rate: Annotated[float, Within(0, 1, low_open=True)]
    """Learning rate at its peak, after the warm-up."""
    muon_rate: Annotated[float, Within(0, 100, unit="x learning_rate")] = 0.0
    """Learning rate of Muon, which updates the matrices, as a multiple of `learning_rate`; with 0,
    AdamW updates every weight."""
    base_widths: BaseWidths = field(default_factory=BaseWidths)
    """Widths for which the rates above and the initial weights are stated; no other width of the
    network changes them unless `width` is one."""
    muon_takes: Literal["matrices", "hidden"] = "matrices"
    """Weights that Muon updates: all matrices, or only the hidden ones of the layers."""
    warmup_steps: Annotated[int, Within(0, 10**9 - 1, unit="steps")]
    """Steps of linear warm-up to the peak learning rate."""
    schedule: Literal["wsd", "cosine"] = "cosine"
    """Course of the learning rate after the warm-up: `wsd` stays at the peak until the last steps,
    so that a run can be extended or branched; `cosine`, the value of runs that store none, falls
    from the start."""
    decay_share: Share = 0.2
    """Fraction of the steps, at the end, over which the rate of a `wsd` schedule falls; with 0 it
    never falls."""
    final_rate_share: Share = 0.05
    """Learning rate at the last step, as a fraction of the peak."""
    weight_decay: Annotated[float, Within(0, 10)] = 0.01
    """Decoupled weight decay (Loshchilov and Hutter 2019) of the weights that `decayed` names."""
    decayed: Literal["all", "matrices"] = "all"
    """Weights that decay: all, or matrices without norms, biases and learned tokens."""
    betas: Annotated[tuple[float, float], BelowOne] = (0.9, 0.99)
    """Decay rates of AdamW's running means of the gradient and of its square."""
    grad_clip: Annotated[float, Within(0, 1e9, low_open=True)] = 1.0
    """Maximum norm of the gradient; larger gradients are scaled down to it."""
    ema_decay: Annotated[float, BelowOne] = 0.0
    """Decay of the exponential moving average (EMA) of the weights, which is what is then evaluated
    and saved; 0 keeps no average."""
    recompute_activations: Annotated[bool, EXECUTION] = False
    """Recompute activations in the backward pass, which saves memory and takes a third more time
    (see RenderFormer.recompute_activations)."""
    compile: Annotated[Compile, EXECUTION] = "auto"
    """Compile layers, head and LPIPS with torch; the first steps then take minutes."""
    shuffle_shards: Annotated[int, Within(1, 100_000, unit="shards")] = 4
    """Number of shards that are open at the same time; samples are shuffled among them."""
    most_unusable: Annotated[int, Within(0, 10**9, unit="samples"), EXECUTION] = 0
    """Maximum number of unusable samples that are replaced by others; with 0, the first one stops
    the run."""
    log_every: FreeCount = 10
    """Steps between rows of metrics.jsonl."""
    validate_every: FreeCount
    """Number of steps between two validations."""
    checkpoint_every: FreeCount
    """Number of steps between two checkpoints."""
    checkpoints_kept: FreeCount = 2
    """Number of newest checkpoints to keep; older ones are deleted."""
    keep_every: Annotated[int, Within(0, 10**9, unit="steps"), EXECUTION] = 0
    """Steps between checkpoints that are never deleted; 0 keeps none of them."""
    validation_scenes: FreeCount = 64
    """Maximum number of scenes of the validation split that are evaluated."""

    def __post_init__(self) -> None:
        picture_px = self.model.picture_px
        if self.resolution % picture_px:
            _wrong("resolution", self.resolution, f"a multiple of {picture_px} for this network")
        for name in ("validate_every", "checkpoint_every"):
            if getattr(self, name) % self.log_every:
                _wrong(name, getattr(self, name), f"a multiple of log_every, {self.log_every}")
        if self.base_widths.width:
            self.base_widths.of(self.model)  # raises where no such network can be
        if self.warmup_steps >= self.num_steps:
            _wrong("warmup_steps", self.warmup_steps, f"0 to {self.num_steps - 1}")


def _wrong(name: str, got: object, expected: str) -> None:
    raise TrilightError(f"train settings: {name} is {got}; expected {expected}.")


_REMOVED = {"model": ModelConfig.REMOVED, "loss": LossSettings.REMOVED}

_BEFORE = {
    "projected_freqs": "rope_max_freq",
    "texture_cells": "material_columns",
    "sky_cells": "texture_cells",
    "lpips_precision": "perceptual_weight",
}
"""Name of the setting after which a removed one is stored."""


def stored_settings(settings: TrainSettings) -> dict[str, Any]:
    """Return the settings as the record that files hold."""
    record = settings_record(settings)
    for group, removed in _REMOVED.items():
        for name, off in removed.items():
            entries = list(record[group].items())
            place = list(record[group]).index(_BEFORE[name]) + 1
            record[group] = dict([*entries[:place], (name, off), *entries[place:]])
    if not record["model"]["denoise_from_px"]:
        del record["model"]["denoise_from_px"]  # a later setting: older files lack it
    return record


def known_settings(record: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return a stored record without removed settings.

    Args:
        record: settings by name; some may be missing.
        source: name of the record in a refusal.

    Raises:
        TrilightError: a removed setting is used.
    """
    known = {
        group: without_removed(record[group], removed, f"{source}: {group}")
        for group, removed in _REMOVED.items()
        if isinstance(record.get(group), Mapping)
    }
    return {**record, **known}


OnHang = Literal["wait", "stop"]
"""Action when a step does not end."""


@checked("watch settings")
class WatchSettings:
    """Monitoring of a run; decides no weight."""

    hang_after_s: Annotated[float, Within(0.1, 1e6, unit="seconds")] = 120.0
    """Time after which a step may count as hanging; before three of its kind are known, five times
    as long."""
    hang_factor: Annotated[float, Within(1, 1e6, unit="x the usual")] = 10.0
    """Multiple of the usual time from which on a step counts as hanging."""
    on_hang: OnHang = "wait"
    """Action on a hang, after it is reported and the stacks of all threads are written: wait, or
    stop the run, which --resume continues from the last checkpoint."""
    spike_bound: Annotated[float, Within(1, 1e6, unit="deviations")] = 8.0
    """Robust standard deviations above the recent median at which a loss or gradient is recorded
    with the scenes of its step."""
    profile: Annotated[int, Within(0, 1000, unit="steps")] = 0
    """Number of steps to trace with PyTorch's profiler, after the first three; 0 traces none."""
    wandb: str | None = None
    """Project of Weights & Biases that the log is written to as well, if the package is installed;
    offline unless WANDB_MODE says otherwise. By default nothing is."""


def decay_start_step(settings: TrainSettings) -> int | None:
    """Return the number of steps after which a constant rate begins to fall.

    None if the schedule has no constant rate, or no decay.
    """
    if settings.schedule != "wsd" or not settings.decay_share:
        return None
    begins = settings.num_steps - round(settings.decay_share * settings.num_steps)
    return max(begins, settings.warmup_steps)


def learning_rate(step: int, settings: TrainSettings) -> float:
    """Return the scheduled rate of steps 0 to num_steps - 1: the first above 0, the last final.

    A warm-up, then a constant rate and a decay, or one cosine. A constant rate does not depend on
    the number of steps. So until its decay begins, a run is exactly the first part of any longer
    run, and can be extended from there (Hägele et al. 2024).
    """
    if step < settings.warmup_steps:
        return settings.learning_rate * (step + 1) / (settings.warmup_steps + 1)
    is_cosine = settings.schedule == "cosine"
    begins = settings.warmup_steps if is_cosine else decay_start_step(settings)
    if begins is None or step < begins:
        return settings.learning_rate
    decayed = min((step - begins) / max(settings.num_steps - 1 - begins, 1), 1.0)
    height = 0.5 * (1 + math.cos(math.pi * decayed)) if is_cosine else 1 - math.sqrt(decayed)
    final = settings.learning_rate * settings.final_rate_share
    return final + (settings.learning_rate - final) * height
