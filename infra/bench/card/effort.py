"""How much `trilight bench card` measures: a card at full size, a processor in the same form."""

import dataclasses
from dataclasses import dataclass

from model.config import ModelConfig, hits_smoke, smoke, tiny
from train.settings import TrainSettings


@dataclass(frozen=True, kw_only=True)
class CardEffort:
    """Sizes of what is measured."""

    name: str
    """`card` or `processor`."""
    steps: int
    """Steps of each run that are timed."""
    warm_steps: int
    """Steps before them, which are not."""
    product_width: int
    """Width of the square product whose speed counts as the peak."""
    copied_mib: int
    """Size of what is copied within the card and to it, MiB."""
    shrunk: bool
    """Whether runs are of small networks, pictures and scenes instead of their own."""
    scenes: int
    """Scenes of the build `smoke` that are rendered, fewer than a shard of it."""
    picture_px: int
    """Pixels across their four views."""
    noise_floor_db: float
    """Noise floor that they are rendered to."""
    loader_s: float
    """Least seconds of reading for each number of threads."""


CARD = CardEffort(
    name="card",
    steps=10,
    warm_steps=3,
    product_width=8192,
    copied_mib=1024,
    shrunk=False,
    scenes=3,
    picture_px=256,
    noise_floor_db=38.0,
    loader_s=10.0,
)
PROCESSOR = dataclasses.replace(
    CARD, name="processor", steps=2, warm_steps=1, product_width=512, copied_mib=64, shrunk=True,
    scenes=2, picture_px=64, noise_floor_db=25.0, loader_s=1.0,
)  # fmt: skip

SHRUNK_PX, SHRUNK_TRIANGLES, SHRUNK_SCENES = 32, 64, 2


def sized(settings: TrainSettings, effort: CardEffort) -> TrainSettings:
    """Return a run at the size that an effort measures."""
    if not effort.shrunk:
        return settings
    return dataclasses.replace(
        settings,
        model=_small(settings.model),
        resolution=SHRUNK_PX,
        most_triangles=SHRUNK_TRIANGLES,
        scenes_per_step=SHRUNK_SCENES,
        scenes_per_pass=min(settings.scenes_per_pass, SHRUNK_SCENES),
        views_per_scene=min(settings.views_per_scene, 2),
    )


def _small(model: ModelConfig) -> ModelConfig:
    if model.view_stage == "hits":
        return dataclasses.replace(hits_smoke(), scene_tokens=model.scene_tokens)
    return tiny() if model.head == "dpt" else smoke()
