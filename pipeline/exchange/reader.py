"""Opens the `SRC` of a command, a file or a sample of a shard, and reads its scenes.

    scene.json                 RenderFormer scene; its meshes lie in the folder of the file
    scene.safetensors          storage.records.scene_file
    scene.h5                   the published layout (pipeline.exchange.renderformer_h5)
    scene.glb .gltf            glTF 2.0 (pipeline.exchange.gltf)
    scene.usda .usdc .usdz .usd   a USD stage (pipeline.exchange.usd)
    train-000000.tar::KEY      the sample KEY of a shard
    scenes.usdc::KEY           a scene of a USD shard, or a time code of an animated stage

Only this module splits `FILE::KEY`, so that no library that parses URLs ever sees it. Files are
untrusted: a child process with limits reads them, and checked scenes alone come back.
"""

import contextlib
import logging
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.formats import (
    FORMATS,
    SEPARATOR,
    LoadedScene,
    SceneFormat,
    SceneSource,
    readable_suffixes,
)
from pipeline.exchange.from_description import AlbedoOverOne, Cameras, LoadedMesh
from pipeline.exchange.scene_files import load_mesh_file
from pipeline.isolation import (
    NO_FILES,
    ChildFailed,
    ChildLimits,
    IsolatedChild,
    Result,
    call_with_retries,
    reach,
)
from storage.dataset.shard_set import expand_pattern
from storage.errors import TrilightError
from storage.remote.url import safe_url
from storage.renderer import Camera

log = logging.getLogger("trilight.exchange")

_KEY = re.compile(r"[0-9A-Za-z_.\-]+")


def scene_source(text: str, *, many: bool = False) -> SceneSource:
    """Return the source that the text of `SRC` names, without opening the file.

    `many` accepts a shard without a key.

    Raises:
        TrilightError: a URL, a missing file, or a name in none of these forms.
    """
    expected = f"expected a scene {' '.join(readable_suffixes())}, or SHARD.tar{SEPARATOR}KEY"
    if "://" in text:
        raise TrilightError(f"{safe_url(text)}: only files of this machine are read; {expected}.")
    name, separator, key = text.rpartition(SEPARATOR)
    path = Path(name if separator else text)
    form = FORMATS.get(path.suffix.lower())
    is_keyed = form is not None and form.keys is not None and bool(_KEY.fullmatch(key))
    for is_wrong, why in (
        (separator and not is_keyed, "no shard and key"),
        (path.is_dir(), "a folder"),
        (not path.exists(), "no such file"),
        (form is None or form.read is None, "cannot be read as a scene"),
    ):
        if is_wrong:
            raise TrilightError(f"{text}: {why}; {expected}.")
    if form is not None and form.always_many and not (separator or many):
        raise TrilightError(f"{text}: a shard holds many scenes; expected {text}{SEPARATOR}KEY.")
    return SceneSource(path=path, key=key if separator else None)


def source_keys(source: SceneSource) -> Sequence[str | None]:
    """Return the key of every scene of a source; [None] for a single scene.

    Only child processes call this, since a stage may be read.
    """
    keys = _form_of(source).keys
    return [source.key] if source.key is not None or keys is None else keys(source)


def load_cameras(source: SceneSource) -> Cameras:
    """Read the cameras alone: poses [C, 4, 4] and angles [C] in degrees.

    Only child processes call this. A JSON file needs nothing but its list `cameras`.

    Raises:
        TrilightError: the file is unusable.
    """
    form = _form_of(source)
    if form.cameras:
        return form.cameras(source)
    scene = load_source(source).scene
    return scene.c2w, scene.fov_deg


def load_camera(source: SceneSource, view: int) -> Cameras:
    """Read one camera of a scene, by its row; as `load_cameras`."""
    camera = Camera.of_scene(load_source(source).scene, view, "--view")
    return camera.c2w[None], np.array([camera.fov_deg], np.float32)


def load_source(source: SceneSource, pictures: bool = False) -> LoadedScene:
    """Read a scene with all of its cameras; only child processes call this.

    `pictures` also reads the pictures of a shard's sample or an HDF5 file.

    Raises:
        TrilightError: anything in the file is unusable, or the scene breaks a law (`Scene.check`).
    """
    read = _form_of(source).read
    assert read is not None, source
    loaded = read(source, pictures)
    if not FORMATS.is_ours(source.path.suffix.lower()):
        loaded.scene.check()
        return loaded
    notes = tuple(f"{source.name}: {text}" for text in loaded.notes)
    return replace(loaded, notes=notes)


def _form_of(source: SceneSource) -> SceneFormat:
    return FORMATS[source.path.suffix.lower()]


class SceneReader(contextlib.AbstractContextManager["SceneReader"]):
    """A child process that reads any number of sources; close it, or use a `with` block."""

    def __init__(self, *, writes: Iterable[Path] = ()) -> None:
        """Create the reader, whose child may write into some folders; it starts with a call."""
        self._child = IsolatedChild(limits=LIMITS, confined_to=NO_FILES, writes=writes)

    def scenes_of(self, source: SceneSource) -> list[SceneSource]:
        """Return a source for each scene of a file, in the order of the file.

        Raises:
            TrilightError: the file is unusable, or holds no scene.
        """
        keys = self._read(source_keys, source)
        if not keys:
            raise TrilightError(f"{source.name}: holds no scene.")
        return [replace(source, key=key) for key in keys]

    def list_scenes(
        self, text: str, albedo_over_one: AlbedoOverOne = "scale", *, many: bool = True
    ) -> list[SceneSource]:
        """Return every scene of a source, in order.

        Args:
            text: one file; `scenes/{000..119}.json` for numbered ones; or a folder, whose scene
                files are sorted by the numbers in their names. A shard stands for all of its
                samples, an animated USD stage for all of its frames.
            albedo_over_one: treatment of albedos over 1 in RenderFormer's JSON.
            many: False where `text` must name one scene, whose file is not opened.

        Raises:
            TrilightError: a file is unusable, or there is no scene.
        """
        names = [text]
        is_folder = many and "://" not in text and Path(text).is_dir()
        if is_folder:
            suffixes = readable_suffixes()
            paths = [path for path in Path(text).iterdir() if path.suffix.lower() in suffixes]
            if not paths:
                raise TrilightError(
                    f"{text}: holds no scene file; expected files that end in {' '.join(suffixes)}."
                )
            names = [str(path) for path in sorted(paths, key=_by_number)]
        elif many and "{" in text:
            names = expand_pattern(text, "scenes")
        holds_many = many and not is_folder
        files = [
            replace(scene_source(name, many=holds_many), albedo_over_one=albedo_over_one)
            for name in names
        ]
        if not holds_many:
            return files
        return [scene for file in files for scene in self.scenes_of(file)]

    def load(self, source: SceneSource, *, pictures: bool = False) -> LoadedScene:
        """Read one scene; as `load_source`."""
        return self._read(load_source, source, pictures)

    def cameras(self, file: SceneSource, view: int | None = None) -> list[Camera]:
        """Read all cameras of the scene of a file, or one of each frame of an animated stage.

        Args:
            file: JSON file with a list `cameras` as in RenderFormer's scenes, or any scene.
            view: row of the camera in each frame; None for all cameras of the first frame alone.

        Raises:
            TrilightError: the file is unusable, or has no such camera.
        """
        frames = [file] if view is None else self.scenes_of(file)
        if view is None or len(frames) == 1:
            tables = [self._read(load_cameras, frames[0])]
        else:
            tables = [self._read(load_camera, each, view) for each in frames]
        return [
            Camera(c2w=pose, fov_deg=float(angle))
            for table in tables
            for pose, angle in zip(*table, strict=True)
        ]

    def mesh(self, path: Path, licence: str) -> LoadedMesh:
        """Read the mesh of an object file; log the parts of the file that are ignored.

        Raises:
            TrilightError: the file is not a usable mesh, or cannot be read.
        """
        self._child.allow_files(reach([path]))
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

    def _read(self, function: Callable[..., Result], source: SceneSource, *args: int) -> Result:
        """Call a function of a source; a complaint about its file names the path as it was given.

        Readers say the name alone, since others write what they say into datasets.
        """
        folders = [] if source.usd_folder is None else [source.usd_folder]
        self._child.allow_files(reach([source.path, *folders]))
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


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts frame9 before frame10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in parts]


LIMITS = ChildLimits(memory_bytes=16 << 30, wall_s=1800, calls_per_child=1000)
