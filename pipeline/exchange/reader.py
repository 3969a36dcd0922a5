"""Reads scenes of untrusted files in a child process with limits; returns checked scenes only."""

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.formats import LoadedScene, SceneSource
from pipeline.exchange.from_description import AlbedoOverOne, Cameras, LoadedMesh
from pipeline.exchange.open_scene import load_cameras, load_source, source_keys
from pipeline.exchange.scene_files import load_mesh_file
from pipeline.isolation import (
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    Result,
    call_with_retries,
    reach,
)
from storage.errors import TrilightError

log = logging.getLogger("trilight.exchange")


class SceneReader(contextlib.AbstractContextManager["SceneReader"]):
    """A child process that reads any number of sources; close it, or use a `with` block."""

    def __init__(
        self, albedo_over_one: AlbedoOverOne = "scale", *, writes: Iterable[Path] = ()
    ) -> None:
        """Create the reader; the child starts with the first call.

        Args:
            albedo_over_one: treatment of albedos over 1 in RenderFormer's JSON.
            writes: folders that the child may write into.
        """
        self._child = IsolatedChild(limits=LIMITS, confined_to=reach(writes=writes))
        self._over_one = albedo_over_one

    def scenes_of(self, source: SceneSource) -> list[SceneSource]:
        """Return a source for each scene of a file, in the order of the file.

        Raises:
            TrilightError: the file is unusable, or holds no scene.
        """
        keys = self._read(source_keys, source)
        if not keys:
            raise TrilightError(f"{source.name}: holds no scene.")
        return [dataclasses.replace(source, key=key) for key in keys]

    def load(self, source: SceneSource, *, pictures: bool = False) -> LoadedScene:
        """Read one scene; see `pipeline.exchange.open_scene.load_source`."""
        source = dataclasses.replace(source, albedo_over_one=self._over_one)
        return self._read(load_source, source, pictures)

    def cameras(self, source: SceneSource) -> Cameras:
        """Read poses and angles; see `pipeline.exchange.open_scene.load_cameras`."""
        return self._read(load_cameras, source)

    def mesh(self, path: Path, licence: str) -> LoadedMesh:
        """Read the mesh of an object file; log the parts of the file that are ignored.

        Raises:
            TrilightError: the file is not a usable mesh, or cannot be read.
        """
        self._child.allow_files(reach(files=[path]))
        arguments = (path, path.name, path.name, AssetSettings(), licence)
        mesh = self.call(load_mesh_file, *arguments, name=path.name)
        if mesh.unread:
            log.warning("%s: not read: %s", path.name, "; ".join(mesh.unread))
        return mesh

    def close(self) -> None:
        """End the child."""
        self._child.close()

    def __exit__(self, *error: object) -> None:
        self.close()

    def _read(self, function: Callable[..., Result], source: SceneSource, *args: bool) -> Result:
        """Call a function of a source; a complaint about its file names the path as it was given.

        Readers say the name alone, since others write what they say into datasets.
        """
        folders = [] if source.usd_folder is None else [source.usd_folder]
        self._child.allow_files(reach(files=[source.path, *folders]))
        try:
            return self.call(function, source, *args, name=source.name)
        except TrilightError as error:
            name = source.path.name
            if not str(error).startswith(name):
                raise
            raise type(error)(f"{source.path}{str(error).removeprefix(name)}") from error

    def call(
        self, function: Callable[..., Result], *args: Any, name: str, done: str = "read"
    ) -> Result:
        """Call a function in the child; `name` could not be `done` if the child fails."""
        try:
            return call_with_retries(self._child, function, *args)
        except ChildFailed as failure:
            raise TrilightError(f"{name}: could not be {done} ({failure}).") from failure


LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1000)


def unconfined_child(address_space: Callable[[int], int]) -> IsolatedChild:
    """Return an unconfined child with limits, for scenes that are already read; close it.

    Args:
        address_space: returns the memory limit for what the child renders with, of the usual one.
    """
    memory_bytes = address_space(LIMITS.memory_bytes)
    return IsolatedChild(limits=dataclasses.replace(LIMITS, memory_bytes=memory_bytes))
