"""What all knobs are measured with: one render child, the scenes, their references, the network.

Everything is made when it is first asked for, so that one knob alone costs no more than itself.
"""

import contextlib
import functools
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from infra.bench.assets import clean_sizes, object_records
from infra.bench.harness import Options
from infra.bench.render_child import smoke_child
from infra.bench.renders.named_set import named_set
from infra.bench.renders.references import make_reference
from pipeline.flows.prepare_isolated import preload_mesh_libraries
from pipeline.isolation import ChildLimits, IsolatedChild
from storage.errors import TrilightError
from storage.safe_url import safe_url
from storage.scene import Scene

if TYPE_CHECKING:
    from storage.sample import Sample

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much to measure."""

    scenes: int
    """Of the named set, for errors of pictures."""
    resolution: int
    """Pixels across those pictures: a divisor of the references' 128."""
    max_spp: int
    """Most samples per pixel, of fixed numbers and as a cap; a multiple of 128."""
    fixed_spp: int
    """Samples per pixel where something else is the knob."""
    picture_px: int
    """Pixels across where the whole pipeline's pictures are meant."""
    widths: tuple[int, ...]
    """Of pictures whose resolution is the knob: each twice the one before, the third is usual."""
    objects: int
    """Sources that are decimated."""
    samples: int
    """Rendered scenes of `smoke` that are packed."""
    composed: int
    """Scenes that are composed and not rendered."""
    network: str
    """A name of model.config.SIZES."""
    network_triangles: int
    """Of the scene that it renders."""
    network_px: int
    """Pixels across."""
    repeats: int
    """Counted rounds of what takes turns."""


CAREFUL = Effort(
    scenes=12,
    resolution=128,
    max_spp=1024,
    fixed_spp=256,
    picture_px=256,
    widths=(64, 128, 256, 512),
    objects=16,
    samples=12,
    composed=200,
    network="base",
    network_triangles=1536,
    network_px=256,
    repeats=3,
)
QUICK = Effort(
    scenes=4,
    resolution=128,
    max_spp=512,
    fixed_spp=128,
    picture_px=128,
    widths=(64, 128, 256, 512),
    objects=6,
    samples=2,
    composed=40,
    network="base",
    network_triangles=1536,
    network_px=256,
    repeats=1,
)


LARGE = 1100
"""Clean faces of a source that is decimated, so that most budgets take something away."""


def _nothing() -> None:
    """The fork server has imported everything already."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One scene with what its first view should look like."""

    scene: Scene
    """With one camera."""
    reference_rgb: NDArray[np.float32]
    """[R, R, 3] converged radiance, of other samples."""


class Workshop:
    """Holds what is shared until `close`."""

    def __init__(self, effort: Effort, options: Options) -> None:
        # before any child: pymeshlab takes a second to import, and would be counted as work
        preload_mesh_libraries()
        self.effort, self.options = effort, options
        self._stack = contextlib.ExitStack()
        self._network_s: dict[int, float] = {}

    def close(self) -> None:
        """End the child, delete its folder."""
        self._stack.close()

    @functools.cached_property
    def child(self) -> IsolatedChild:
        """A render child of the build `smoke`, on all cores."""
        folder = self._stack.enter_context(tempfile.TemporaryDirectory())
        child = smoke_child(Path(folder), threads=os.cpu_count() or 1)
        return self._stack.enter_context(contextlib.closing(child))

    @functools.cached_property
    def mesh_child(self) -> IsolatedChild:
        """A child for mesh libraries, one thread."""
        limits = ChildLimits(memory_bytes=8 << 30, wall_s=600, calls_per_child=10_000)
        child = IsolatedChild(limits=limits, setup=_nothing)
        return self._stack.enter_context(contextlib.closing(child))

    @functools.cached_property
    def sources(self) -> tuple[Path, ...]:
        """Files of objects of LARGE faces or more, the largest first; TrilightError for none."""
        sizes = clean_sizes(self.mesh_child, object_records(self.options))
        large = [path for path, faces in sizes.items() if faces >= LARGE]
        if not large:
            raise TrilightError(
                f"objects {', '.join(map(safe_url, self.options.objects))}: none of {len(sizes)} "
                f"usable ones has {LARGE} faces; expected at least one, to be made coarser."
            )
        return tuple(large[: self.effort.objects])

    @functools.cached_property
    def subjects(self) -> tuple[Subject, ...]:
        """Scenes from all over the named set, whose references and words are published."""
        from train.data.resolution import block_mean

        every = named_set(None)
        chosen = [
            every[row * len(every) // self.effort.scenes] for row in range(self.effort.scenes)
        ]
        return tuple(
            Subject(
                scene=named.make(self.child),
                reference_rgb=block_mean(
                    make_reference(named, self.child).radiance_rgb[None], self.effort.resolution
                )[0],
            )
            for named in chosen
        )

    @property
    def scenes_in_words(self) -> str:
        """What pictures are measured on."""
        effort = self.effort
        return (
            f"{effort.scenes} scenes of built-in objects, one view of {effort.resolution} x "
            f"{effort.resolution} each"
        )

    @functools.cached_property
    def samples(self) -> "list[Sample]":
        """Scenes of `smoke` as a run would make them."""
        from infra.bench.samples import rendered_samples
        from pipeline.flows.training_builds import smoke
        from storage.changes import changed

        px = max(self.effort.picture_px, 2 * self.effort.resolution)
        build = changed(smoke(), {"renders.resolution": px})
        return rendered_samples(build, self.options, self.effort.samples, lambda: None)

    def in_turns(
        self, name: str, sides: Mapping[str, Callable[[], Mapping[str, float]]]
    ) -> dict[str, dict[str, float]]:
        """Return the median figures of sides that take turns (infra.bench.harness)."""
        from infra.bench.harness import compare

        result = compare(name, sides, repeats=self.effort.repeats)
        return {
            side: {figure: spread.median for figure, spread in figures.items()}
            for side, figures in result.sides.items()
        }

    def network_core_s(self, triangles: float) -> float:
        """Return core-seconds of the network for a scene of so many triangles and one view.

        Measured once at a few sizes, in between interpolated: one forward pass each.
        """
        if not self._network_s:
            from infra.bench.trade.forward import core_s_by_triangles

            self._network_s = core_s_by_triangles(self.effort)
        sizes = sorted(self._network_s)
        return float(np.interp(triangles, sizes, [self._network_s[size] for size in sizes]))

    def call(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """Run a function in the render child."""
        return self.child.call(function, *arguments)
