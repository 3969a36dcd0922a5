"""Shared means of experiments: children, scenes with references, objects, the network.

Everything is made when it is first asked for, so that an experiment costs no more than it needs.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from infra.bench.effort import Asked, Effort
from infra.bench.subjects.named_scenes import (
    NamedScene,
    described,
    first_sample,
    make_reference,
    sampled,
)
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import smoke
from pipeline.isolation import ChildFailed, ChildLimits, IsolatedChild
from pipeline.making.accept_objects import accept_objects
from pipeline.making.asked_objects import AskedObjects
from pipeline.making.attempt_scene import SceneRecipe, set_up_child
from pipeline.making.begin_publication import begin
from pipeline.making.environment import environment
from pipeline.making.prepare_isolated import preload_mesh_libraries
from pipeline.renders.variant import choose_variant
from storage.dataset.layout import DatasetFolder
from storage.errors import Rejected, TrilightError
from storage.records.scene import Scene

if TYPE_CHECKING:
    from storage.records.objects import ObjectRecord
    from storage.records.sample import Sample


Result = TypeVar("Result")

_LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=4 * 3600, calls_per_child=10_000)


def _nothing() -> None:
    """The fork server has imported everything already."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """One scene with what its first view should look like."""

    scene: Scene
    """The scene, with one camera."""
    reference_rgb: NDArray[np.float32]
    """[R, R, 3] converged radiance, of other samples; R is the effort's resolution."""
    reference_db: float
    """The noise floor of the reference itself, psnr_log_db."""


class Workshop:
    """Makes and holds what experiments share, until `close`."""

    def __init__(self, effort: Effort, asked: Asked, results: Path) -> None:
        # before any child: pymeshlab takes a second to import, and would be counted as work
        preload_mesh_libraries()
        self.effort, self.asked, self.results = effort, asked, results
        self.notes: list[str] = []
        """Notes that belong to the result."""
        self._stack = contextlib.ExitStack()
        self._kept: dict[Any, Any] = {}

    def close(self) -> None:
        """End the children, delete their folders."""
        self._stack.close()

    def kept(self, key: Any, make: Callable[[], Result]) -> Result:
        """Return what was made under a key, made now if it was not."""
        if key not in self._kept:
            self._kept[key] = make()
        found: Result = self._kept[key]
        return found

    def note(self, text: str) -> None:
        """Keep a sentence with the result; once."""
        if text not in self.notes:
            self.notes.append(text)

    def folder(self) -> Path:
        """Return an empty folder that is deleted in the end."""
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory()))

    def closing(self, child: IsolatedChild) -> IsolatedChild:
        """Return a child that is ended with the workshop."""
        return self._stack.enter_context(contextlib.closing(child))

    def entered(self, context: contextlib.AbstractContextManager[Result]) -> Result:
        """Enter a context that is left with the workshop."""
        return self._stack.enter_context(context)

    @functools.cached_property
    def child(self) -> IsolatedChild:
        """A render child of the build `smoke`, on all cores."""
        return self.render_child(smoke(), "builtin:")

    def call(self, function: Callable[..., Result], *arguments: Any) -> Result:
        """Run a function in the render child."""
        return self.child.call(function, *arguments)

    def child_of(self, build: BuildSettings) -> IsolatedChild:
        """Return a render child of another build, with the first source of objects asked for."""
        allowed = dataclasses.replace(build, allowed_licences=self.asked.allowed_licences)
        return self.render_child(allowed, self.asked.objects[0])

    def render_child(
        self, build: BuildSettings, objects: str, threads: int | None = None
    ) -> IsolatedChild:
        """Return a child that composes the scenes of a build and renders them, on all cores.

        Args:
            build: the settings.
            objects: source of the objects.
            threads: of Mitsuba and the denoiser, if fewer than there are cores.
        """
        variant, workers = choose_variant(), threads or os.cpu_count() or 1
        folder = DatasetFolder(self.folder())  # keeps the record of the objects
        publication = begin(folder, build, environment(variant), 1, accept_environment=False)
        asked = AskedObjects(
            source=objects, licence=None, settings=build, publication=publication, workers=workers
        )
        accepted = accept_objects(asked)
        recipe = SceneRecipe(settings=build, variant=variant, threads=workers, pool=accepted.pool)
        return self.closing(IsolatedChild(limits=_LIMITS, setup=set_up_child, setup_args=(recipe,)))

    @functools.cached_property
    def mesh_child(self) -> IsolatedChild:
        """A child for mesh libraries, one thread, with a limit on its processor time."""
        limits = ChildLimits(memory_bytes=8 << 30, wall_s=600, cpu_s=240, calls_per_child=10_000)
        return self.closing(IsolatedChild(limits=limits, setup=_nothing))

    @functools.cached_property
    def objects(self) -> "list[ObjectRecord]":
        """The objects of all sources together; TrilightError as `find_objects`."""
        from pipeline.objects.sources import find_objects
        from storage.cache import cache_folder

        return [
            record
            for source in self.asked.objects
            for record in find_objects(
                source,
                work_dir=cache_folder("objects"),
                allowed_licences=self.asked.allowed_licences,
            ).records
        ]

    @functools.cached_property
    def sources(self) -> tuple[tuple[Path, int], ...]:
        """Files of usable objects with their triangles after cleaning, the largest first."""
        from infra.bench.sides.remeshing import count_faces

        sizes = {}
        for record in self.objects:
            with contextlib.suppress(Rejected, ChildFailed):
                sizes[Path(record.path)] = self.mesh_child.call(count_faces, Path(record.path))
        return tuple(sorted(sizes.items(), key=lambda item: (-item[1], str(item[0]))))

    def source(self, turn: str, least: int) -> Path:
        """Return the object of the turn `object N`, among those of `least` triangles or more.

        Raises:
            Rejected: there are not so many.
        """
        large = [path for path, faces in self.sources if faces >= least]
        number = int(turn.split()[-1])
        if number > len(large):
            raise Rejected("no_object", f"only {len(large)} objects have {least} triangles")
        return large[number - 1]

    def scene(self, name: str) -> Scene:
        """Return a scene of the named set, `sampled N` or one of the user's folder."""
        return self._named(name).make(self.child)

    def subject(self, name: str) -> Subject:
        """Return such a scene with its reference, which a denoiser has seen."""
        return self.kept(("subject", name), lambda: self._subject(name))

    def _named(self, name: str) -> NamedScene:
        named = next((one for one in described(self.asked.scenes) if one.name == name), None)
        if named is None and not name.startswith("sampled "):
            raise TrilightError(f"scene {name!r} is not in --scenes {self.asked.scenes}.")
        return named or sampled(int(name.split()[-1]))

    def _subject(self, name: str) -> Subject:
        from train.data.resolution import block_mean

        named = self._named(name)
        reference = make_reference(named, self.child)
        return Subject(
            scene=named.make(self.child),
            reference_rgb=block_mean(reference.radiance_rgb[None], self.effort.resolution)[0],
            reference_db=reference.noise_floor_db,
        )

    @functools.cached_property
    def samples(self) -> "list[Sample]":
        """Scenes of `smoke` as a run would make them."""
        from storage.settings.changes import changed

        px = max(self.effort.picture_px, 2 * self.effort.resolution)
        child = self.child_of(changed(smoke(), {"renders.resolution": px}))
        return [child.call(first_sample, index) for index in range(self.effort.samples)]

    def network_core_s(self, triangles: float) -> float:
        """Return core-seconds of the network for a scene of so many triangles and one view.

        Measured once at a few sizes, in between interpolated: one forward pass each.
        """
        from infra.bench.sides.networks import core_s_by_triangles

        found = self.kept("network", lambda: core_s_by_triangles(self.effort))
        return float(np.interp(triangles, sorted(found), [found[size] for size in sorted(found)]))
