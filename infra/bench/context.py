"""Shared resources of an experiment: children, scenes, objects, folders.

Each resource is made at its first use, so that an experiment pays only for what it uses.
"""

import contextlib
import dataclasses
import functools
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from infra.bench.experiment import BenchScale
from infra.bench.workloads.named_scenes import given_scenes, preset_scene
from infra.bench_options import BenchOptions
from infra.planning import measure_scenes
from infra.render.held_out_scenes import composing_child
from infra.render.path_tracer import RenderChild
from pipeline.exchange.reader import SceneReader
from pipeline.generation.generate_options import GenerateOptions
from pipeline.generation.prepare_isolated import preload_mesh_libraries
from pipeline.isolation import ChildLimits, IsolatedChild
from pipeline.presets.settings import DatasetSettings
from pipeline.presets.training import smoke
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, write_manifest
from storage.dataset.shard import write_shard
from storage.dataset.splits import shard_name
from storage.dataset.staging import read_staged_scene
from storage.dataset.training_data import TrainingData, open_training_data
from storage.errors import Rejected, TrilightError
from storage.records.sample import sample_key
from storage.records.scene import Scene

_RENDERED = 3
"""Number of rendered scenes, fewer than a shard of the preset."""

Members = Mapping[str, bytes]
"""Files of a sample by name."""

Result = TypeVar("Result")
Closable = TypeVar("Closable", IsolatedChild, RenderChild)


class BenchContext(contextlib.ExitStack):
    """Shared resources of an experiment's trials; its end closes children and deletes folders."""

    def __init__(self, scale: BenchScale, options: BenchOptions) -> None:
        super().__init__()
        # before any child: pymeshlab takes a second to import, and would be counted as work
        preload_mesh_libraries()
        self.scale = scale
        self.options = options
        self.notes: list[str] = []
        """Notes that belong to the result."""
        self.cores = os.cpu_count() or 1
        self._cache: dict[Any, Any] = {}

    def get_or_make(self, key: Any, make: Callable[[], Result]) -> Result:
        """Return the value of a key, made by `make` at its first use."""
        if key not in self._cache:
            self._cache[key] = make()
        result: Result = self._cache[key]
        return result

    def note(self, text: str) -> None:
        """Add a sentence to the result's notes, once."""
        if text not in self.notes:
            self.notes.append(text)

    def folder(self) -> Path:
        """Return an empty folder, which the end deletes."""
        return Path(self.enter_context(tempfile.TemporaryDirectory()))

    def render_child(
        self, settings: DatasetSettings, objects: str, threads: int | None = None
    ) -> IsolatedChild:
        """Return a child that composes scenes of a preset and renders them, until the end."""
        allowed = dataclasses.replace(settings, allowed_licences=self.options.allowed_licences)
        return self.until_closed(composing_child(allowed, objects, self.folder(), threads))

    def until_closed(self, child: Closable) -> Closable:
        """Return a child that the end closes, too."""
        return self.enter_context(contextlib.closing(child))

    @functools.cached_property
    def child(self) -> IsolatedChild:
        """A render child of the preset `smoke` with procedural objects, on all cores."""
        return self.render_child(smoke(), "builtin:")

    @functools.cached_property
    def mesh_child(self) -> IsolatedChild:
        """A child for mesh libraries, one thread, with a limit on its processor time."""
        limits = ChildLimits(memory_bytes=8 << 30, wall_s=600, cpu_s=240, calls_per_child=10_000)
        return self.until_closed(IsolatedChild(limits=limits))

    def scene(self, trial: str) -> Scene:
        """Return the scene of the trial `sampled N`, or the user's scene of that name."""

        def make() -> Scene:
            source = given_scenes(self.options.scenes).get(trial)
            if source is None:
                return preset_scene(self.child, smoke(), int(trial.split()[-1]))
            try:
                with SceneReader() as reader:
                    return reader.load(source).scene
            except TrilightError as error:
                raise Rejected("no_scene", str(error)) from error

        return self.get_or_make(("scene", trial), make)

    @functools.cached_property
    def rendered(self) -> list[Members]:
        """Files of some scenes of the preset `smoke`, at the scale's width."""
        folder = DatasetFolder(self.folder())
        splits = smoke().splits
        options = GenerateOptions(
            build="smoke", resolution=self.scale.picture_px, scenes=splits.scenes_per_shard
        )
        measure_scenes(options, _RENDERED, folder.root, lambda: None)
        staged = folder.staged_shard(shard_name(0, splits))
        return [read_staged_scene(staged, row)[0] for row in range(_RENDERED)]

    @functools.cached_property
    def data(self) -> TrainingData:
        """Data of the options, or a dataset with copies of the rendered scenes."""
        if self.options.data:
            return open_training_data([self.options.data])
        root = self.folder()
        write_copies(root, self.rendered)
        return open_training_data([str(root)])


def write_copies(
    root: Path, members: Sequence[Members], *, copies: int = 16, per_shard: int = 16
) -> int:
    """Write a dataset that holds each sample under many keys; return the number of samples.

    Args:
        root: folder of the dataset; it may be missing.
        copies: number of keys of each sample.
    """
    folder = DatasetFolder(root)
    every = [(sample_key(k), members[k % len(members)]) for k in range(copies * len(members))]
    names = []
    for number, start in enumerate(range(0, len(every), per_shard)):
        names.append(f"train-{number:06d}.tar")
        write_shard(folder.shard(names[-1]), every[start : start + per_shard])
    manifest = Manifest(
        build="bench", settings={}, environment={}, num_scenes=len(every), num_views=4,
        objects_lock_sha256="", shards=tuple(index_shard(folder.shard(name)) for name in names),
    )  # fmt: skip
    write_manifest(folder.manifest, manifest)
    return len(every)
