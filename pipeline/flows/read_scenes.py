"""Scenes of a user's files, read in a child process with limits; only checked scenes come out."""

import dataclasses
from collections.abc import Callable
from types import TracebackType

from pipeline.flows.file_child import file_child
from pipeline.flows.scene_formats import Cameras, LoadedScene, SceneSource
from pipeline.flows.scene_source import load_cameras, load_source, source_keys
from pipeline.isolation import ChildFailed, Result, call_with_retries
from pipeline.scenes.described_albedos import AlbedoOverOne
from storage.errors import TrilightError


class SceneReader:
    """One child for any number of sources; close it, or use it in a `with` block."""

    def __init__(self, albedo_over_one: AlbedoOverOne = "scale") -> None:
        """Start nothing yet.

        Args:
            albedo_over_one: of RenderFormer's JSON, where albedos add up to more than 1.
        """
        self._child = file_child()
        self._over_one = albedo_over_one

    def scenes_of(self, source: SceneSource) -> list[SceneSource]:
        """Return each scene that a file holds as a source of its own, in the order of the file.

        Raises:
            TrilightError: the file is unusable, or holds no scene.
        """
        keys = self._call(source_keys, source)
        if not keys:
            raise TrilightError(f"{source.name}: holds no scene.")
        return [dataclasses.replace(source, key=key) for key in keys]

    def load(self, source: SceneSource) -> LoadedScene:
        """Read one scene; raises TrilightError as `scene_source.load_source`."""
        source = dataclasses.replace(source, albedo_over_one=self._over_one)
        return self._call(load_source, source)

    def cameras(self, source: SceneSource) -> Cameras:
        """Return poses and angles; raises TrilightError as `scene_source.load_cameras`."""
        return self._call(load_cameras, source)

    def __enter__(self) -> "SceneReader":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._child.close()

    def _call(self, function: Callable[[SceneSource], Result], source: SceneSource) -> Result:
        try:
            return call_with_retries(self._child, function, source)
        except ChildFailed as failure:
            raise TrilightError(f"{source.name}: could not be read ({failure}).") from failure
