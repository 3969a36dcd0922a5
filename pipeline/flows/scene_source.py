"""What `SRC` means where a command wants one scene: a file of its own, or a sample of a shard.

    scene.json                 RenderFormer scene; its meshes lie in the folder of the file
    scene.safetensors          storage.scene_file
    scene.h5                   the published layout (storage.renderformer_h5)
    scene.usda .usdc .usdz .usd   a USD stage (pipeline.scenes.usd)
    train-000000.tar::KEY      the sample KEY of a shard
    scenes.usdc::KEY           a scene of a shard in USD, or a time code of a stage that moves

The last form is taken apart here and nowhere else: no library that knows URLs ever sees it.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.assets.settings import AssetSettings
from pipeline.flows.scene_files import build_scene, cameras_by, described_by
from pipeline.objects.licences import USER_PROVIDED
from pipeline.scenes.described_albedos import AlbedoOverOne
from pipeline.scenes.from_description import scaled_albedo_notes
from pipeline.scenes.usd.read import read_usd, usd_keys
from storage.errors import TrilightError
from storage.profiles import PACKED, PLAIN
from storage.renderformer_h5_read import read_renderformer_h5
from storage.safe_url import safe_url
from storage.sample import decode_sample, decode_scene
from storage.scene import Scene
from storage.scene_file import read_scene_file
from storage.shard_reader import iterate_samples, read_members
from storage.usd.opening import SUFFIXES as USD_SUFFIXES

SEPARATOR = "::"
"""Between a shard and the key of a sample."""

SUFFIXES = (".json", ".safetensors", ".h5", *USD_SUFFIXES)
"""Of files that are scenes."""

_KEY = re.compile(r"[0-9A-Za-z_.\-]+")
_EXPECTED = "expected a scene .json, .safetensors, .h5 or .usda .usdc .usdz, or SHARD.tar::KEY"
_MEMBERS = ("json", PLAIN, PACKED)


@dataclass(frozen=True, kw_only=True)
class SceneSource:
    """Where one scene is."""

    path: Path
    """The file."""
    key: str | None
    """Which scene of it, where it holds many."""
    usd_folder: Path | None = None
    """A USD file may name files below it; below its own folder by default."""
    albedo_over_one: AlbedoOverOne = "scale"
    """Of RenderFormer's JSON: what to do where albedos add up to more than 1."""

    @property
    def name(self) -> str:
        """What may be published: the file without its folders, and the key."""
        return self.path.name if self.key is None else f"{self.path.name}{SEPARATOR}{self.key}"


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadedScene:
    """A scene as it was read."""

    scene: Scene
    """It passes `Scene.check`."""
    notes: tuple[str, ...]
    """What a person should know: what of a file means nothing, or could not be carried over."""
    radiance_rgb: NDArray[np.float32] | None = None
    """[V, R, R, 3] pictures of all views, where they were asked for and the source has them."""


def scene_source(
    text: str,
    *,
    many: bool = False,
    usd_folder: Path | None = None,
    albedo_over_one: AlbedoOverOne = "scale",
) -> SceneSource:
    """Return what the user's `SRC` names; the file is not opened yet.

    Args:
        text: what the user typed.
        many: whether a shard without a key will do.
        usd_folder, albedo_over_one: see `SceneSource`.

    Raises:
        TrilightError: a URL, no such file, or a name that is none of the forms.
    """
    if "://" in text:
        raise TrilightError(f"{safe_url(text)}: only files of this machine are read; {_EXPECTED}.")
    name, separator, key = text.rpartition(SEPARATOR)
    path = Path(name if separator else text)
    suffix = path.suffix.lower()
    if separator and (suffix not in (".tar", *USD_SUFFIXES) or not _KEY.fullmatch(key)):
        raise TrilightError(f"{text}: no shard and key; {_EXPECTED}.")
    if path.is_dir():
        raise TrilightError(f"{text}: a folder; {_EXPECTED}.")
    if not path.exists():
        raise TrilightError(f"{text}: no such file; {_EXPECTED}.")
    if not separator and suffix == ".tar" and not many:
        raise TrilightError(f"{text}: a shard holds many scenes; expected {text}{SEPARATOR}KEY.")
    if not separator and suffix not in (".tar", *SUFFIXES):
        raise TrilightError(f"{text}: cannot be read as a scene; {_EXPECTED}.")
    return SceneSource(
        path=path,
        key=key if separator else None,
        usd_folder=usd_folder,
        albedo_over_one=albedo_over_one,
    )


def source_keys(source: SceneSource) -> list[str | None]:
    """Return the key of every scene that a source names; [None] where it is one scene.

    Only children come here, since a stage may be read.
    """
    if source.key is not None:
        return [source.key]
    suffix = source.path.suffix.lower()
    if suffix == ".tar":
        return [key for key, _ in iterate_samples(source.path)]
    if suffix in USD_SUFFIXES:
        return [key or None for key in usd_keys(source.path, source.usd_folder)]
    return [None]


def load_cameras(source: SceneSource) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read the cameras alone, poses [C, 4, 4] and angles [C]; only children come here.

    A JSON file needs nothing but its list `cameras`.

    Raises:
        TrilightError: as `load_source`.
    """
    if source.path.suffix.lower() == ".json":
        return cameras_by(source.path.parent.resolve(), source.path.name)
    scene = load_source(source).scene
    return scene.c2w, scene.fov_deg


def load_source(source: SceneSource, *, pictures: bool = False) -> LoadedScene:
    """Read a scene, with all of its cameras; only children come here, since meshes may be read.

    Args:
        source: which.
        pictures: whether to read those of a shard's sample or an HDF5 file too.

    Raises:
        TrilightError: anything in the file is unusable, or breaks a law of scenes.
    """
    suffix = source.path.suffix.lower()
    if suffix in USD_SUFFIXES:
        usd = read_usd(source.path, source.key, source.usd_folder, USER_PROVIDED)
        return LoadedScene(
            scene=usd.scene, notes=tuple(f"{source.name}: {text}" for text in usd.lost)
        )
    if source.key is not None:
        return _load_sample(source.path, source.key, pictures=pictures)
    if suffix == ".safetensors":
        return LoadedScene(scene=read_scene_file(source.path), notes=())
    root, name = source.path.parent.resolve(), source.path.name
    if suffix == ".h5":
        found = read_renderformer_h5(source.path)
        return LoadedScene(
            scene=found.scene,
            notes=tuple(f"{name}: {text}" for text in found.lost),
            radiance_rgb=found.radiance_rgb if pictures else None,
        )
    unknown = described_by(root, name).unknown_fields
    scene, _ = build_scene(
        root,
        name,
        AssetSettings(),
        licence=USER_PROVIDED,
        num_views=None,
        scene_index=0,
        seed=0,
        albedo_over_one=source.albedo_over_one,
    )
    texts = (*(f"unknown field {field}" for field in unknown), *scaled_albedo_notes(scene))
    return LoadedScene(scene=scene, notes=tuple(f"{name}: {text}" for text in texts))


def _load_sample(path: Path, key: str, *, pictures: bool) -> LoadedScene:
    record = decode_scene(key, read_members(path, key, _MEMBERS))
    try:
        record.scene.check()
    except TrilightError as error:
        raise TrilightError(f"sample {key}: {error}") from error
    if not pictures:
        return LoadedScene(scene=record.scene, notes=())
    names = (*_MEMBERS, *(f"{view}.exr" for view in range(len(record.views))))
    sample = decode_sample(key, read_members(path, key, names))
    return LoadedScene(scene=sample.scene, notes=(), radiance_rgb=sample.radiance_rgb)
