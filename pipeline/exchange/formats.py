"""Table of the scene formats, by file suffix.

A file may be hostile, so only child processes read it (pipeline.exchange.reader); a child loads the
extensions that have added a format.

Each format states the members of a scene that it carries. Every other member that is not at its
default is reported as lost, so that no writer drops one silently. A member is a field of
`Scene`, or a part of one: `materials.diffuse` (storage.records.material) and `objects.uid`
(SceneObject). A format that carries `materials` carries all columns, added ones too.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.from_description import AlbedoOverOne, Cameras
from pipeline.exchange.gltf import read_gltf, write_gltf
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.exchange.renderformer_json import write_renderformer_json
from pipeline.exchange.scene_files import build_scene, read_scene_cameras
from pipeline.exchange.textured_triangles import LoadedScene as LoadedScene
from pipeline.exchange.textured_triangles import Pictures as Pictures
from pipeline.foreign.limits import WRITTEN_USD_SUFFIXES
from pipeline.objects.licences import USER_PROVIDED
from storage.atomic import write_atomically
from storage.dataset.shard import open_shard
from storage.errors import TrilightError
from storage.records import scene_file
from storage.records.material import PUBLISHED_COLUMNS, columns_in_use
from storage.records.profiles import PACKED, PLAIN
from storage.records.retextured import without_maps, without_normal_maps
from storage.records.sample import decode_sample, decode_scene, require_lawful
from storage.records.scene import ARRAY_FIELDS, MAP_ARRAYS, Scene, SceneObject
from storage.records.scene_file import encode_scene, read_scene_file
from storage.registry import Registry

SEPARATOR = "::"
"""Separates the name of a file of many scenes from the key of one."""

_MEMBERS = ("json", PLAIN, PACKED)


@dataclass(frozen=True, kw_only=True)
class SceneSource:
    """Path and key of one scene."""

    path: Path
    """Local path of the scene file."""
    key: str | None
    """Key of the scene in a file of many; None for a file of one scene."""
    usd_folder: Path | None = None
    """Folder whose files a USD file may name; None stands for the folder of the file."""
    albedo_over_one: AlbedoOverOne = "scale"
    """Treatment of albedos that add up to more than 1 in RenderFormer's JSON."""

    @property
    def name(self) -> str:
        """Name for messages and notes: the file without its folders, and the key."""
        return self.path.name if self.key is None else f"{self.path.name}{SEPARATOR}{self.key}"


@dataclass(frozen=True, kw_only=True)
class SceneFormat:
    """Functions of one scene format; None where the format cannot do it."""

    read: Callable[[SceneSource, bool], LoadedScene] | None = None
    """Reads a scene, and its pictures where the second argument says so; raises TrilightError."""
    keys: Callable[[SceneSource], Sequence[str | None]] | None = None
    """Returns the key of each scene in a file; None stands for the only scene of a file."""
    always_many: bool = False
    """True where a file always holds many scenes, so that a source needs a key."""
    cameras: Callable[[SceneSource], Cameras] | None = None
    """Reads the cameras alone, where that needs less than the whole scene."""
    write: Callable[[Path, Scene, Pictures], Iterable[str]] | None = None
    """Writes a scene that passes `Scene.check`, and returns what of `carried` was lost."""
    write_many: Callable[[Path, Iterable[tuple[str, Scene]]], None] | None = None
    """Writes scenes with their keys into one file."""
    named_files: Callable[[Path], Sequence[Path]] | None = None
    """Returns the further files that a written file names."""
    carried: Collection[str] = frozenset()
    """Members of a scene that the format holds; other members in use are noted as lost."""
    holds_pictures: bool = False
    """True where `write` stores the pictures of the views."""


def readable_suffixes() -> list[str]:
    """Return the suffixes of files that hold one scene and can be read."""
    return [suffix for suffix, form in FORMATS.items() if form.read and not form.always_many]


def _list_usd_pictures(target: Path) -> Sequence[Path]:
    from pxr import UsdUtils

    if target.suffix.lower() == ".usdz":
        return []
    names = UsdUtils.ComputeAllDependencies(str(target))[1]
    return [target.parent / Path(name).name for name in sorted(names)]


def _read_usd(source: SceneSource, pictures: bool) -> LoadedScene:
    from pipeline.exchange.usd.read_usd import read_usd  # as all of USD, slow to load

    return read_usd(source.path, source.key, source.usd_folder)


def _list_usd_scenes(source: SceneSource) -> list[str | None]:
    from pipeline.exchange.usd.read_usd import usd_keys

    return [key or None for key in usd_keys(source.path, source.usd_folder)]


def _write_usd(target: Path, scene: Scene, pictures: Pictures) -> Iterable[str]:
    from pipeline.exchange.usd.write_usd import write_usd

    return write_usd(target, scene)


def _write_usd_shard(target: Path, scenes: Iterable[tuple[str, Scene]]) -> None:
    from pipeline.exchange.usd.write_usd import write_usd_shard

    write_usd_shard(target, scenes)


def _read_json(source: SceneSource, pictures: bool) -> LoadedScene:
    loaded, _ = build_scene(
        source.path.parent.resolve(),
        source.path.name,
        AssetSettings(),
        licence=USER_PROVIDED,
        albedo_over_one=source.albedo_over_one,
    )
    return loaded


def _write_scene_file(target: Path, scene: Scene, pictures: Pictures) -> Iterable[str]:
    write_atomically(target, encode_scene(scene))
    return ()


def _list_samples(source: SceneSource) -> list[str | None]:
    with open_shard(source.path) as opened:
        return list(opened.samples)


def _read_sample(source: SceneSource, pictures: bool) -> LoadedScene:
    key = str(source.key)
    with open_shard(source.path) as opened:
        record = decode_scene(key, opened.members(key, _MEMBERS.__contains__))
        require_lawful(record)
        if not pictures:
            return LoadedScene(scene=record.scene, notes=())
        names = (*_MEMBERS, *(f"{view}.exr" for view in range(len(record.views))))
        sample = decode_sample(key, opened.members(key, names.__contains__))
    return LoadedScene(scene=sample.scene, notes=(), radiance_rgb=sample.radiance_rgb)


_OBJECTS = {"object_index", "objects.name", "objects.kind"}
_GEOMETRY = {*ARRAY_FIELDS, *_OBJECTS} - {"materials"}
_GEOMETRY |= {f"materials.{name}" for name in PUBLISHED_COLUMNS}
"""Members that the formats of other programs hold: triangles, cameras and published columns."""

_READ_USD = SceneFormat(read=_read_usd, keys=_list_usd_scenes)
_USD = dataclasses.replace(
    _READ_USD,
    write=_write_usd,
    write_many=_write_usd_shard,
    named_files=_list_usd_pictures,
    carried=scene_file.CARRIED,
)
_READ_GLTF = SceneFormat(read=lambda source, _: read_gltf(source.path))

FORMATS: Registry[SceneFormat] = Registry(
    "scene format",
    SceneFormat,
    {
        **dict.fromkeys(WRITTEN_USD_SUFFIXES, _USD),
        ".usd": _READ_USD,
        ".json": SceneFormat(
            read=_read_json,
            cameras=lambda source: read_scene_cameras(
                source.path.parent.resolve(), source.path.name
            ),
            write=lambda target, scene, _: write_renderformer_json(target, scene),
            carried=_GEOMETRY,
        ),
        ".glb": dataclasses.replace(
            _READ_GLTF,
            write=lambda target, scene, _: write_gltf(target, scene),
            carried=_GEOMETRY | {"textures", "normal_textures"},
        ),
        ".gltf": _READ_GLTF,
        ".h5": SceneFormat(
            read=lambda source, pictures: read_renderformer_h5(source.path, pictures=pictures),
            write=write_renderformer_h5,
            carried=_GEOMETRY - _OBJECTS | {"textures"},
            holds_pictures=True,
        ),
        ".safetensors": SceneFormat(
            read=lambda source, _: LoadedScene(scene=read_scene_file(source.path), notes=()),
            write=_write_scene_file,
            carried=scene_file.CARRIED,
        ),
        ".tar": SceneFormat(
            read=_read_sample,
            keys=_list_samples,
            always_many=True,
        ),
    },
)
"""Formats by suffix, in lower case with the point."""


def list_lost_members(scene: Scene, carried: Collection[str]) -> tuple[str, ...]:
    """Return one text that lists the members which a format loses; empty without losses."""
    lost = [
        member
        for member in _members_in_use(scene)
        if not {member, member.partition(".")[0]} & set(carried)
    ]
    return (", ".join(lost),) if lost else ()


def _members_in_use(scene: Scene) -> Iterator[str]:
    """Yield the members of a scene that are not at their defaults."""
    for field in dataclasses.fields(Scene):
        value = getattr(scene, field.name)
        if field.name == "materials":
            yield from (f"materials.{name}" for name in columns_in_use(value))
        elif field.name == "objects":
            for part in dataclasses.fields(SceneObject):
                if any(getattr(entry, part.name) != part.default for entry in value):
                    yield f"objects.{part.name}"
        elif field.name in ("environment", "normal_textures"):
            yield from () if value is None else (field.name,)
        elif field.name not in MAP_ARRAYS and len(value):
            yield field.name  # other MAP_ARRAYS belong to `textures`


def drop_uncarried_maps(scene: Scene, carried: Collection[str]) -> Scene:
    """Return the scene without the textures or environment that a format does not carry.

    Raises:
        TrilightError: the environment is the only light, and the format cannot hold it.
    """
    if "normal_textures" not in carried:
        scene = without_normal_maps(scene)
    loses_sky = scene.environment is not None and "environment" not in carried
    if loses_sky and not scene.triangle_emits.any():
        raise TrilightError(
            "scene: its only light is its environment, which this form cannot hold; expected an "
            "emitter too. Write it as .safetensors."
        )
    return without_maps(scene, textures="textures" not in carried, environment=loses_sky)
