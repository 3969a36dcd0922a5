"""Training presets. The command line can replace any field: `--set loss.perceptual=none`.

`paper-*` are the recipe of RenderFormer (Zeng et al. 2025, and its published training code): two
stages, AdamW, one cosine, random rigid motions; `-large` are those of its larger network. Likely
mistakes of that code are not repeated: positions rounded to bfloat16, a learning rate that starts
again, samples drawn with replacement, and the loss after the ELU. `pretrain` and `finetune` are
ours: their rate is constant until the last fifth, so that they can be extended and branched.
`builtin` and `hits` have the cosine schedule of the networks that Trilight ships.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from model.config import SIZES, BaseWidths
from storage.aliases import PRESET_ALIASES
from storage.errors import TrilightError
from storage.extensions import mistakes_of_entry
from storage.registry import Registry
from storage.settings.overrides import apply_overrides
from train.settings import AugmentationSettings, LossSettings, TrainSettings

_SMOKE = TrainSettings(
    run="smoke",
    model=SIZES["smoke"](),
    resolution=64,
    loss=LossSettings(perceptual="none"),
    augmentation=AugmentationSettings(mirror=True, channels=True, vertex_order=True),
    num_steps=360,
    scenes_per_step=4,
    views_per_scene=4,
    learning_rate=1.5e-3,
    schedule="wsd",
    warmup_steps=50,
    validate_every=60,
    checkpoint_every=60,
)
"""The run that proves within five minutes on two CPU cores that training works."""

_BUILTIN = dataclasses.replace(
    _SMOKE,
    run="builtin",
    num_steps=9_000,
    learning_rate=1e-3,
    schedule="cosine",
    muon_rate=3.0,
    weight_decay=0.1,
    warmup_steps=200,
    ema_decay=0.999,
    validate_every=500,
    checkpoint_every=500,
)
"""The run of the shipped pure network: an hour on two CPU cores."""

_HITS = dataclasses.replace(
    _BUILTIN,
    run="hits",
    model=dataclasses.replace(SIZES["hits-smoke"](), scene_tokens=False),
    num_steps=2_400,
    views_per_scene=2,
    ema_decay=0.998,
    validate_every=200,
    checkpoint_every=200,
    augmentation=dataclasses.replace(_SMOKE.augmentation, rotation="uniform", withheld_inputs=0.05),
)
"""The run of a small network whose visible surfaces and direct light are traced.

It has no scene tokens: with traced inputs they gain nothing at this size (study S72).
"""

_HITS_TOKENS = dataclasses.replace(_HITS, run="hits-tokens", model=SIZES["hits-smoke"]())
"""The run `hits` with scene tokens, to measure what they gain."""

_PAPER_PRETRAIN = TrainSettings(
    run="paper-pretrain",
    model=SIZES["base"](),
    resolution=256,
    most_triangles=1536,
    loss=LossSettings(perceptual="lpips", perceptual_weight=0.05),
    augmentation=AugmentationSettings(rotation="recipe", translation=0.25),
    num_steps=500_000,
    scenes_per_step=128,
    views_per_scene=2,
    scenes_per_pass=16,
    precision="bfloat16",
    recompute_activations=True,
    learning_rate=1e-4,
    schedule="cosine",
    warmup_steps=8_000,
    final_rate_share=0.01,
    betas=(0.9, 0.999),
    shuffle_shards=16,
    log_every=20,
    validate_every=5_000,
    checkpoint_every=1_000,
    keep_every=50_000,
    validation_scenes=256,
)
"""The first stage of the paper: 256 pixels, up to 1536 triangles.

It follows the paper's text, 500,000 steps. The launcher that made the published Base says 1.3
million: `paper-pretrain-launcher`.
"""

_PAPER_PRETRAIN_LAUNCHER = dataclasses.replace(
    _PAPER_PRETRAIN, run="paper-pretrain-launcher", num_steps=1_300_000, keep_every=100_000
)
"""The first stage with the 1.3 million steps of the published Base's launcher.

There the cosine ends after 1,208,000 steps, and the warm-up begins again; here one cosine has
all steps.
"""

_PAPER_FINETUNE = dataclasses.replace(
    _PAPER_PRETRAIN,
    run="paper-finetune",
    from_weights=True,
    resolution=512,
    most_triangles=4096,
    num_steps=100_000,
    scenes_per_step=64,
    scenes_per_pass=4,
    learning_rate=5e-5,
    keep_every=20_000,
)
"""The second stage of the paper, from the first: 512 pixels, up to 4096 triangles."""

_PAPER_PRETRAIN_LARGE = dataclasses.replace(
    _PAPER_PRETRAIN,
    run="paper-pretrain-large",
    model=SIZES["large"](),
    num_steps=600_000,
    scenes_per_step=32,
    scenes_per_pass=4,
    recompute_activations=False,
)
"""The first stage of the published Large recipe: 483 M parameters, Swin windows.

Its training code says 4 scenes a GPU, 2 views of each, 600,000 steps of which 8,000 rise to a
rate of 1e-4, and no recomputation. It does not say how many GPUs: 8, its documentation's
example, make the 32 scenes here. The validation and its intervals are ours, since it has none.
"""

_PAPER_FINETUNE_LARGE = dataclasses.replace(
    _PAPER_FINETUNE,
    run="paper-finetune-large",
    model=SIZES["large"](),
    num_steps=50_000,
    scenes_per_step=48,
    scenes_per_pass=6,
    warmup_steps=4_000,
    keep_every=10_000,
)
"""The second stage of the published Large recipe: 512 pixels, up to 4096 triangles.

6 scenes a GPU, 50,000 steps of which 4,000 rise to 5e-5, both stages of the network recomputed.
For the number of GPUs see `paper-pretrain-large`.
"""

_PRETRAIN = dataclasses.replace(
    _PAPER_PRETRAIN,
    run="pretrain",
    loss=LossSettings(perceptual="lpips", perceptual_weight=0.05, noise_half=0.03),
    augmentation=dataclasses.replace(_SMOKE.augmentation, rotation="uniform", light_scale=2.0),
    num_steps=250_000,
    learning_rate=7e-4,
    base_widths=BaseWidths(width=64),
    schedule="wsd",
    muon_rate=3.0,
    warmup_steps=2_000,
    final_rate_share=0.02,
    betas=(0.9, 0.99),
    ema_decay=0.9995,
    decayed="matrices",
    muon_takes="hidden",
    recompute_activations=False,
)
"""Our first stage: half the paper's steps, all symmetries, less weight for noisy views.

Which of these choices helps was measured in small trainings (study S79); at this size none
has been. Half the steps with Muon are as good as all with AdamW at 1 million parameters, four
seeds (-4.7 to 2.8 % of the error).

The rate is where Muon's error is least from 0.28 to 21 million parameters, and follows the
width from 64 on (`base_widths`): two seeds, 2,000 steps of four scenes at 32 pixels, on an H100
(study S80). Parabolas have their least error between 6.2e-4 and 8.5e-4 at each width, with no
trend. It was not measured whether this rate is the best at Base, of 195 million, in steps of
128 scenes or over 250,000 of them.
"""

_FINETUNE = dataclasses.replace(
    _PRETRAIN,
    run="finetune",
    from_weights=True,
    resolution=512,
    most_triangles=4096,
    num_steps=50_000,
    scenes_per_step=64,
    scenes_per_pass=4,
    learning_rate=2.3e-4,
    keep_every=10_000,
)
"""Our second stage, which follows our first as the paper's second follows its first.

Its rate, a third of the first stage's, has not been tried at this size either.
"""

_HITS_256 = dataclasses.replace(
    _PRETRAIN,
    run="hits-256",
    model=SIZES["hits-base"](),
    augmentation=dataclasses.replace(_PRETRAIN.augmentation, withheld_inputs=0.05),
)
"""Our first stage with traced hits at Base size, for a GPU; only tried for some steps.

Tracing and denoising a view of 256 pixels takes 0.2 to 0.45 CPU seconds: the 256 views of a
step keep 50 cores busy for a second or two, so that with fewer cores the loader limits the
speed.
"""

_OURS = (
    _SMOKE, _BUILTIN, _HITS, _HITS_TOKENS, _HITS_256, _PRETRAIN, _FINETUNE, _PAPER_PRETRAIN,
    _PAPER_PRETRAIN_LAUNCHER, _PAPER_FINETUNE, _PAPER_PRETRAIN_LARGE, _PAPER_FINETUNE_LARGE,
)  # fmt: skip

TRAINING_PRESETS: Registry[Callable[[], TrainSettings]] = Registry(
    "training preset",
    Callable,
    {preset.run: partial(dataclasses.replace, preset) for preset in _OURS},
    decides=("weights",),
    aliases=PRESET_ALIASES,
)
"""Training presets by name."""

_INTERVALS = ("log_every", "validate_every", "checkpoint_every", "keep_every")
"""Settings that are numbers of steps between two events."""


def resolve_training_preset(typed: str) -> str:
    """Return the name of a training preset that was typed on a command line.

    For FILE.py:FUNCTION it registers the TrainSettings that the user's function returns. Names from
    other sources must not be passed, since the file is executed.

    Raises:
        TrilightError: as `Registry.resolve`, or the function returns something else.
    """
    return TRAINING_PRESETS.resolve(typed, _as_preset)


def _as_preset(settings: Any) -> Callable[[], TrainSettings]:
    if not isinstance(settings, TrainSettings):
        raise TrilightError(f"it returned a {type(settings).__name__}; expected TrainSettings.")
    return lambda: settings


def training_preset(name: str) -> TrainSettings:
    """Return the settings of a training preset.

    Raises:
        TrilightError: the name is unknown, or a user's preset has the name of one of ours.
    """
    with mistakes_of_entry(f"training preset {name!r}"):
        preset = TRAINING_PRESETS.find(name)()
    if not TRAINING_PRESETS.is_ours(name) and TRAINING_PRESETS.is_ours(preset.run):
        raise TrilightError(
            f"training preset {name!r}: its settings say run={preset.run!r}, which is one of "
            f"Trilight's own; expected another name, such as dataclasses.replace(..., "
            f"run='my-{preset.run}')."
        )
    return preset


def override_training_preset(
    name: str,
    changes: Mapping[str, Any],
    *,
    steps: int | None = None,
    most_unusable: int | None = None,
) -> TrainSettings:
    """Return the settings of a training preset with some values replaced.

    Args:
        changes: values by dotted name, as `storage.settings.overrides` takes them.
        steps: replaces the number of steps; if it is smaller, the warm-up and the intervals that
            `changes` does not name shrink in proportion.
        most_unusable: replaces that setting, after the changes.

    Raises:
        TrilightError: no such preset or setting, or an invalid value; the message names it.
    """
    run = training_preset(name)
    every = dict(changes)
    if steps is not None:
        every |= {**scale_intervals(run, steps, changes), "num_steps": steps}
    if most_unusable is not None:
        every["most_unusable"] = most_unusable
    return apply_overrides(run, every)


def scale_intervals(run: TrainSettings, steps: int, stated: Mapping[str, Any]) -> dict[str, int]:
    """Return the scaled warm-up and intervals of a shorter run; nothing for a longer one.

    Each interval is a multiple of another: validations and checkpoints fall on rows of the log, and
    permanent checkpoints on checkpoints.

    Args:
        steps: the smaller number of steps.
        stated: values by name that the user gave; these are kept.
    """
    if not 0 < steps < run.num_steps:
        return {}
    # other values are refused, by name, when the settings are made
    known = {name: value for name, value in stated.items() if isinstance(value, int)}
    intervals = {name: known[name] for name in _INTERVALS if known.get(name, 0) > 0}

    def shorter(name: str, unit: int) -> int:
        exact = getattr(run, name) * steps / run.num_steps
        return int(intervals.get(name, max(round(exact / unit), 1) * unit))

    on_rows = (intervals.get(name, 0) for name in ("validate_every", "checkpoint_every"))
    row = math.gcd(shorter("log_every", 1), *on_rows)
    scaled_steps = {
        "warmup_steps": round(run.warmup_steps * steps / run.num_steps),
        "log_every": row,
        "validate_every": shorter("validate_every", row),
        "checkpoint_every": shorter("checkpoint_every", row),
    }
    if run.keep_every:
        scaled_steps["keep_every"] = shorter("keep_every", scaled_steps["checkpoint_every"])
    return {name: value for name, value in scaled_steps.items() if name not in stated}
