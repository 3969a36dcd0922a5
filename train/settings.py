"""Training runs: one frozen description of everything that decides the weights. Without torch.

A run is a Python function that returns the whole description (train.runs); the command line picks
one and may replace fields. What is not here cannot be changed.
"""

from dataclasses import field
from typing import Annotated, Literal

from model.config import ModelConfig
from storage.errors import TrilightError
from storage.settings.described import checked
from storage.settings.ranges import Seed, Share, Within

Rotation = Literal["none", "recipe", "uniform"]
"""`recipe`: a rotation vector of three normal numbers, which favours small turns; `uniform`: every
orientation alike."""


@checked("train settings")
class AugmentationSettings:
    """What is drawn anew at every visit of a scene. The default changes nothing."""

    rotation: Rotation = "none"
    """How scene and cameras are turned together."""
    translation: Annotated[float, Within(0, 100, unit="metres")] = 0.0
    """Standard deviation per axis of their common shift, metres."""
    mirror: bool = False
    """Whether half of the visits see the mirrored scene."""
    channels: bool = False
    """Whether the colour channels are permuted."""
    vertex_order: bool = False
    """Whether each triangle begins with any of its vertices."""
    light_scale: Annotated[float, Within(1, 1000)] = 1.0
    """Largest factor by which all light is made stronger or weaker, log-uniform."""
    light_mix: Annotated[float, Within(1, 1000)] = 1.0
    """Largest such factor for each light alone; needs a dataset that keeps lights apart
    (`per_light`)."""


Perceptual = Literal["lpips", "ms_ssim", "none"]
"""`lpips` is the recipe's and needs published weights; `ms_ssim` needs none and is another term."""


@checked("train settings")
class LossSettings:
    """Terms of the loss (Zeng et al. 2025, section 4) and how views are weighed."""

    perceptual: Perceptual
    """The second term, on tone-mapped pictures."""
    perceptual_weight: Annotated[float, Within(0, 1000)] = 0.05
    """Weight of the perceptual term beside the L1 error of log10(1 + radiance)."""
    noise_half: Annotated[float, Within(0, 10)] = 0.0
    """Root mean square noise of log10(1 + radiance) at which a view has half the weight; 0: all
    views have the same."""


Precision = Literal["float32", "bfloat16"]
"""Precision of the network's matrix products. Positions, losses, weights and optimisers' memories
stay float32."""

Count = Annotated[int, Within(1, 10**9)]
"""Of steps or of scenes; a billion is never reached."""

BelowOne = Within(0, 1, high_open=True)
"""Of the decay of a running mean; at 1 it would never move."""


@checked("train settings")
class TrainSettings:
    """Everything that decides which weights come out, beside the data."""

    run: str
    """Name of the run."""
    model: ModelConfig
    """The network."""
    from_weights: bool = False
    """Whether the run begins with given weights (`begin_with`) instead of random ones."""
    resolution: Annotated[int, Within(1, 2048, unit="pixels")]
    """Pixels across the training pictures: a divisor of the data's, a multiple of the bundle's, or
    of a window of bundles."""
    most_triangles: Annotated[int, Within(0, 1_000_000, unit="triangles")] = 0
    """Maximum number of triangles of a scene; others are unusable; 0: no limit."""
    seed: Seed = 0
    """Seed of the initial weights, the order of samples and augmentation."""
    loss: LossSettings
    """What is minimised."""
    augmentation: AugmentationSettings = field(default_factory=AugmentationSettings)
    """Symmetries under which scenes are shown."""
    num_steps: Count
    """Updates of the weights; the learning rate ends its cosine at the last one."""
    scenes_per_step: Annotated[int, Within(1, 65_536, unit="scenes")]
    """Scenes whose gradients are averaged into one update."""
    views_per_scene: Annotated[int, Within(1, 1000, unit="views")]
    """Views of a scene in a step, drawn anew at every visit; at most as many as the data holds."""
    scenes_per_pass: Annotated[int, Within(1, 65_536, unit="scenes")] = 16
    """Most scenes that go through the network at once; gradients of the passes of a step add up."""
    precision: Precision = "float32"
    """Precision of the network's matrix products."""
    learning_rate: Annotated[float, Within(0, 1, low_open=True)]
    """Peak learning rate."""
    muon_rate: Annotated[float, Within(0, 100, unit="x learning_rate")] = 0.0
    """Learning rate of Muon, which then updates the matrices; 0: AdamW updates every weight."""
    warmup_steps: Annotated[int, Within(0, 10**9 - 1, unit="steps")]
    """Steps of linear rise to the peak."""
    final_rate_share: Share = 0.05
    """Learning rate at the last step, as a share of the peak."""
    weight_decay: Annotated[float, Within(0, 10)] = 0.01
    """Decoupled decay of every weight (Loshchilov and Hutter 2019)."""
    betas: Annotated[tuple[float, float], BelowOne] = (0.9, 0.99)
    """Decay rates of AdamW's running means of the gradient and of its square."""
    grad_clip: Annotated[float, Within(0, 1e9, low_open=True)] = 1.0
    """Largest gradient norm; longer gradients are scaled down to it."""
    ema_decay: Annotated[float, BelowOne] = 0.0
    """Decay of the moving average (EMA) of the weights, which is then judged and kept; 0: no
    average."""
    recompute_activations: bool = False
    """Trade a third more time for memory: see RenderFormer.recompute_activations."""
    shuffle_shards: Annotated[int, Within(1, 100_000, unit="shards")] = 4
    """Shards that are open at the same time, among whose samples is shuffled."""
    most_unusable: Annotated[int, Within(0, 10**9, unit="samples")] = 0
    """Maximum number of damaged samples that are replaced by others; 0: the first one ends the
    run."""
    log_every: Count = 10
    """Steps between rows of metrics.jsonl."""
    validate_every: Count
    """Steps between validations."""
    checkpoint_every: Count
    """Steps between checkpoints."""
    checkpoints_kept: Count = 2
    """Newest checkpoints that stay; older ones are deleted."""
    keep_every: Annotated[int, Within(0, 10**9, unit="steps")] = 0
    """Steps between checkpoints that are kept for good; 0: none is."""
    validation_scenes: Count = 64
    """Most scenes of the validation split that are judged."""

    def __post_init__(self) -> None:
        picture_px = self.model.picture_px
        if self.resolution % picture_px:
            _wrong("resolution", self.resolution, f"a multiple of {picture_px} for this network")
        for name in ("validate_every", "checkpoint_every"):
            if getattr(self, name) % self.log_every:
                _wrong(name, getattr(self, name), f"a multiple of log_every, {self.log_every}")
        if self.warmup_steps >= self.num_steps:
            _wrong("warmup_steps", self.warmup_steps, f"0 to {self.num_steps - 1}")


def _wrong(name: str, got: object, expected: str) -> None:
    raise TrilightError(f"train settings: {name} is {got}; expected {expected}.")
