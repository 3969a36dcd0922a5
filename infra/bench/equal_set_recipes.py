"""Ways to spend the same core-seconds on a training set: one change at a time from `usual`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

COMMON: Mapping[str, object] = {
    "renders.resolution": 64,
    "renders.noise_floor_db": 38.0,
    "renders.max_spp": 256,
    "scenes.max_triangles": 768,
    "assets.budgets": [600, 420, 300, 200, 120, 70],
    # small, so that a set can be cut where its core-seconds are spent
    "splits.scenes_per_shard": 4,
    # all shards but two are for training: others judge
    "splits.shards_per_cycle": 1_000_000,
}
"""What all sets share unless their recipe says otherwise."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """One way to make a training set."""

    words: str
    """What is different, for people."""
    changes: Mapping[str, object] = field(default_factory=dict)
    """Settings of the build `smoke` that differ from COMMON."""

    @property
    def arguments(self) -> list[str]:
        """What `trilight generate smoke` is told."""
        settings = {**COMMON, **self.changes}
        return [
            word
            for name, value in settings.items()
            for word in ("--set", f"{name}={_json_like(value)}")
        ]


USUAL = "usual"

RECIPES: Mapping[str, Recipe] = {
    USUAL: Recipe(words="38 dB or 256 samples, 4 views, 768 triangles"),
    "noisy": Recipe(
        words="28 dB or 16 samples",
        changes={"renders.noise_floor_db": 28.0, "renders.min_spp": 8, "renders.max_spp": 16},
    ),
    "clean": Recipe(
        words="46 dB or 1024 samples",
        changes={"renders.noise_floor_db": 46.0, "renders.max_spp": 1024},
    ),
    "two-views": Recipe(words="2 views a scene", changes={"scenes.num_views": 2}),
    "many-views": Recipe(words="12 views a scene", changes={"scenes.num_views": 12}),
    "coarse": Recipe(words="600 triangles a scene", changes={"scenes.max_triangles": 600}),
}
"""By name; all are judged on the same scenes of JUDGE."""

JUDGE = Recipe(
    words="48 validation scenes at 46 dB or 1024 samples, of another seed",
    changes={
        "renders.noise_floor_db": 46.0,
        "renders.max_spp": 1024,
        "splits.scenes_per_shard": 48,
        "splits.shards_per_cycle": 8,
    },
)
"""What every training is judged on."""

JUDGE_ARGUMENTS = ("--seed", "1000", "--shards", "802:803")
"""The third shard of a cycle is for validation, whose objects no training sees; one far behind, so
that no sample has the key of one that is learned from."""


def _json_like(value: object) -> str:
    """Return a value as `--set` takes it."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ",".join(str(entry) for entry in value) + "]"
    return str(value)
