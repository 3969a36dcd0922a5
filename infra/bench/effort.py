"""How much is measured, and on what: minutes with `--quick`, else what quoted figures need."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.objects.licences import DEFAULT_ALLOWED
from storage.settings.described import checked


@dataclass(frozen=True, kw_only=True)
class Effort:
    """Numbers that experiments draw their points and turns from."""

    name: str
    """`quick` or `careful`."""
    scenes: int
    """Scenes of the named set, for errors of pictures."""
    resolution: int
    """Pixels across those pictures: a divisor of the references' 128."""
    max_spp: int
    """Most samples per pixel, of fixed numbers and as a cap; a multiple of 128."""
    fixed_spp: int
    """Samples per pixel where something else is varied."""
    picture_px: int
    """Pixels across where the whole pipeline's pictures are meant."""
    widths: tuple[int, ...]
    """Picture widths where the resolution is varied, doubling; the third is the default."""
    objects: int
    """Objects that are decimated."""
    samples: int
    """Rendered scenes of `smoke` that are packed and read."""
    composed: int
    """Scenes that are composed and not rendered."""
    network: str
    """A name of model.config.SIZES."""
    network_triangles: int
    """Triangles of the scene that the network renders."""
    network_px: int
    """Pixels across the pictures of the network."""
    repeats: int
    """Counted rounds where the same is done several times."""
    judged_scenes: int
    """Scenes of each source of objects whose stated floors are judged."""
    reference_spp: int
    """Samples per pixel of the references of those, at 256 pixels."""
    growth: int
    """How far sizes that double go: largest source of a mesh, triangles and views of a network."""


CAREFUL = Effort(
    name="careful",
    scenes=12,
    resolution=128,
    max_spp=1024,
    fixed_spp=256,
    picture_px=256,
    widths=(64, 128, 256, 512),
    objects=24,
    samples=12,
    composed=200,
    network="base",
    network_triangles=1536,
    network_px=256,
    repeats=3,
    judged_scenes=30,
    reference_spp=512,
    growth=4,
)
QUICK = dataclasses.replace(
    CAREFUL, name="quick", scenes=4, max_spp=512, fixed_spp=128, picture_px=128, objects=6,
    samples=2, composed=40, repeats=1, judged_scenes=3, reference_spp=256, growth=2,
)  # fmt: skip


_WEIGHTS = "model.safetensors"
"""File of weights in the folder of a run."""


@checked()
class Asked:
    """The inputs of the experiments."""

    objects: tuple[str, ...] = ("builtin:",)
    """Sources of objects."""
    allow_licences: tuple[str, ...] = ()
    """Licences of objects to allow in addition to the usual ones; by default there are none."""
    scenes: Path | None = None
    """Folder of RenderFormer scenes to render as well; by default none."""
    checkpoint: tuple[str, ...] = ("builtin:",)
    """Networks to measure; by default the one that comes with Trilight. Experiments on one network
    take the first, and those that compare pair every other row with it."""
    data: str | None = None
    """Finished dataset (a folder or a URL) for the experiments economy and loader, and for those
    that train (repairs, learning-rates, optimisers, schedules); by default none."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where learning-rates, optimisers and schedules train."""

    @property
    def network(self) -> str:
        """The first network."""
        return self.checkpoint[0]

    @property
    def network_names(self) -> tuple[str, ...]:
        """What networks are called: by the folder of a run, and by no path of this machine."""
        places = [Path(place) for place in self.checkpoint]
        return tuple(
            place.parent.name if place.name == _WEIGHTS else place.name for place in places
        )

    @property
    def allowed_licences(self) -> tuple[str, ...]:
        """Licences of objects that may be measured."""
        return (*DEFAULT_ALLOWED, *self.allow_licences)
