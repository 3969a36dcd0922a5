"""Resolves the `SRC` of a command to one scene: a file, or a sample of a shard.

    scene.json                 RenderFormer scene; its meshes lie in the folder of the file
    scene.safetensors          storage.records.scene_file
    scene.h5                   the published layout (pipeline.exchange.renderformer_h5)
    scene.glb .gltf            glTF 2.0 (pipeline.exchange.gltf)
    scene.usda .usdc .usdz .usd   a USD stage (pipeline.exchange.usd)
    train-000000.tar::KEY      the sample KEY of a shard
    scenes.usdc::KEY           a scene of a USD shard, or a time code of an animated stage

Only this module splits `FILE::KEY`, so that no library that parses URLs ever sees it.
"""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.exchange.formats import (
    FORMATS,
    SEPARATOR,
    LoadedScene,
    SceneFormat,
    SceneSource,
    readable_suffixes,
)
from pipeline.exchange.from_description import AlbedoOverOne, Cameras
from storage.errors import TrilightError
from storage.remote.safe_url import safe_url

_KEY = re.compile(r"[0-9A-Za-z_.\-]+")


def scene_source(
    text: str,
    *,
    many: bool = False,
    usd_folder: Path | None = None,
    albedo_over_one: AlbedoOverOne = "scale",
) -> SceneSource:
    """Return the source that the text of `SRC` names, without opening the file.

    `many` accepts a shard without a key; the other options are those of `SceneSource`.

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
    return SceneSource(
        path=path,
        key=key if separator else None,
        usd_folder=usd_folder,
        albedo_over_one=albedo_over_one,
    )


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
    return dataclasses.replace(loaded, notes=notes)


def _form_of(source: SceneSource) -> SceneFormat:
    return FORMATS[source.path.suffix.lower()]
