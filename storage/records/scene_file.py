"""A `Scene` as bytes: its arrays as they lie in a shard, and a whole scene as one file.

A `.safetensors` scene holds the arrays of `Scene` under their names, and one metadata entry
`trilight_scene`: JSON with schema version, objects and provenance. (One entry, because the library
writes several in any order.) Equal scenes give equal bytes. Of a textured scene, the textures stand
among the arrays as `texture.0`, `texture.1`, ..., and the map of an environment as `environment`.

Such a file comes from anywhere. Its size and its header are checked before an array is made, of
which none takes more than its part of the file; names must be exactly those of a scene, and the
laws of `Scene.check`, types and shapes among them, hold for every scene that is returned.
"""

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.conventions import MAPS_VERSION, READABLE_VERSIONS, SCHEMA_VERSION
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError, prefix_errors
from storage.records.material import chosen_columns, completed_rows, stored_columns, stored_names
from storage.records.packed_maps import (
    MapEntry,
    Maps,
    checked_map,
    held_values,
    maps_of,
    stored_values,
)
from storage.records.retextured import without_constant_textures
from storage.records.safe_read import name_unreadable, open_plain, read_safetensors
from storage.records.scene import (
    ARRAY_FIELDS,
    MAP_ARRAYS,
    MAX_TEXTURES,
    ObjectKind,
    Scene,
    SceneObject,
)
from storage.records.scene_laws import wrong_value
from storage.records.texture import MAX_MAPS_BYTES, Texture
from storage.typed_json import FINITE, Converted, read_versioned

MAX_FILE_BYTES = (256 << 20) + MAX_MAPS_BYTES
"""A million triangles with three vertices each take 90 MB."""

MAX_HEADER_BYTES = 8 << 20
"""An object takes 150 bytes and its attribution; there are at most 65,536."""

CARRIED = frozenset(
    {*ARRAY_FIELDS, "objects", "provenance", "textures", "normal_textures", "environment"}
)
"""What the form holds of a scene (pipeline.exchange.formats): all of it, added columns too."""

_METADATA = "trilight_scene"
_COLUMNS = "material_columns"
_MAPS_DIGEST = "maps_sha256"
_TEXTURE = "texture."
_ENVIRONMENT = "environment"


def encode_arrays(scene: Scene) -> bytes:
    """Return the arrays of a scene alone, as the member `scene.safetensors` of a sample.

    Material columns beyond the published ones stand there where they are not at their default; then
    the metadata name all of them.
    """
    scene = without_constant_textures(scene)
    arrays, stated = _arrays(scene)
    if (maps := maps_of(scene)) is not None:
        arrays[_MAPS_DIGEST] = maps.digest
    return save(arrays, None if stated is None else {_COLUMNS: stated})


def decode_arrays(data: bytes, maps: Maps | None = None) -> dict[str, NDArray]:
    """Return the array fields of a scene from the bytes of `encode_arrays`.

    Args:
        data: the bytes.
        maps: what the record of the scene says of its maps.

    Raises:
        TrilightError: damaged, an array is missing, a material column is not declared here, or the
            arrays are those of a scene with other maps.
    """
    arrays, metadata = read_safetensors(data)
    if missing := set(ARRAY_FIELDS) - set(arrays):
        raise TrilightError(f"scene: the array {min(missing)} is missing.")
    arrays["materials"] = completed_rows(arrays["materials"], metadata.get(_COLUMNS))
    stored_digest = arrays[_MAPS_DIGEST].tobytes() if _MAPS_DIGEST in arrays else None
    if stored_digest != (None if maps is None else maps.digest.tobytes()):
        raise TrilightError(
            "scene: its record and its arrays do not speak of the same textures and environment. "
            "Run `trilight verify`."
        )
    return {name: arrays[name] for name in (*ARRAY_FIELDS, *MAP_ARRAYS) if name in arrays}


def scene_digest(scene: Scene) -> str:
    """Return the sha256 of `encode_arrays`: equal where geometry, materials and cameras are."""
    return sha256_hex(encode_arrays(scene))


def encode_scene(scene: Scene) -> bytes:
    """Return the `.safetensors` file of a scene.

    Raises:
        TrilightError: the scene breaks a law, or is larger than `decode_scene_file` accepts.
    """
    scene.check()
    scene = without_constant_textures(scene)
    record = scene_record(scene)
    arrays, stated = _arrays(scene)
    if stated is not None:
        record[_COLUMNS] = stated
    if scene.textures:
        record["is_srgb"] = [texture.is_srgb for texture in scene.textures]
    for row, texture in enumerate(scene.textures):
        arrays[f"{_TEXTURE}{row}"] = np.ascontiguousarray(stored_values(texture.texels))
    if scene.environment is not None:
        radiance = stored_values(scene.environment.radiance_rgb)
        arrays[_ENVIRONMENT] = np.ascontiguousarray(radiance)
    data = save(arrays, {_METADATA: canonical_json(record).decode()})
    header_bytes = int.from_bytes(data[:8], "little")
    if len(data) > MAX_FILE_BYTES or header_bytes > MAX_HEADER_BYTES:
        raise TrilightError(
            f"scene: its file takes {len(data)} bytes with a header of {header_bytes}; expected at "
            f"most {MAX_FILE_BYTES} and {MAX_HEADER_BYTES}."
        )
    return data


def read_scene_file(path: Path) -> Scene:
    """Return the scene of a `.safetensors` file; its size is checked before it is read.

    Raises:
        TrilightError: it cannot be read, or as `decode_scene_file`.
    """
    with name_unreadable(path.name), open_plain(path) as stream:
        if os.fstat(stream.fileno()).st_size > MAX_FILE_BYTES:
            raise TrilightError(f"{path.name}: expected a file of at most {MAX_FILE_BYTES} bytes.")
        return decode_scene_file(stream.read(), path.name)


def decode_scene_file(data: bytes, name: str) -> Scene:
    """Return the scene of a `.safetensors` file held in memory.

    Args:
        data: the bytes.
        name: of the file, for messages.

    It raises TrilightError where it is larger than MAX_FILE_BYTES or damaged, has an array too
    many, too few or of another type or shape, metadata that are not a scene's or of another schema
    version, or breaks a law.
    """
    if len(data) > MAX_FILE_BYTES:
        raise TrilightError(f"{name}: {len(data)} bytes; expected at most {MAX_FILE_BYTES}.")
    with prefix_errors(name):
        arrays, metadata = read_safetensors(data, MAX_HEADER_BYTES)
        _check_names(arrays)
        if _METADATA not in metadata:
            raise TrilightError(f"scene: metadata {_METADATA} are missing.")
        record = read_scene_record(
            metadata[_METADATA], SceneJson, "scene: its record", (SCHEMA_VERSION, MAPS_VERSION)
        )
        arrays["materials"] = completed_rows(arrays["materials"], record.material_columns)
        fields = _maps(record, arrays)
        fields |= {name: arrays[name] for name in (*ARRAY_FIELDS, *MAP_ARRAYS) if name in arrays}
        scene = record.scene(**fields)
        scene.check()
        return scene


def scene_provenance(value: Any) -> Mapping[str, Any]:
    """Return the provenance of a JSON value.

    Raises:
        TrilightError: it is no object, or its template or excursion is malformed.
    """
    if not isinstance(value, dict):
        wrong_value("provenance", value, "a JSON object")
    if not isinstance(value.get("template", ""), str):
        wrong_value("provenance.template", value["template"], "text")
    excursion = value.get("excursion")
    if excursion and not (
        isinstance(excursion, dict)
        and isinstance(excursion.get("axis"), str)
        and isinstance(excursion.get("value"), int | float)
    ):
        wrong_value("provenance.excursion", excursion, "an axis and a value")
    return value


@dataclass(frozen=True, kw_only=True)
class StatedObject:
    """Row of the objects in a scene's record: a `SceneObject`, all of it stated."""

    name: str
    kind: ObjectKind
    uid: str
    licence: str
    attribution: str
    source_url: str


@dataclass(frozen=True, kw_only=True)
class SceneJson:
    """Record of a scene: what is no array of it, as JSON."""

    schema_version: int
    objects: tuple[StatedObject, ...]
    provenance: Annotated[Mapping[str, Any], Converted(scene_provenance), FINITE]
    maps: Maps | None = None
    material_columns: str | None = None
    """Columns of the materials in a scene file (storage.records.material), if they are others than
    the published ones."""
    is_srgb: tuple[bool, ...] = ()
    """Encoding of each texture in a scene file."""

    def scene(self, **fields: Any) -> Scene:
        """Return the scene with all other fields, whose laws are not checked."""
        objects = tuple(SceneObject(**vars(entry)) for entry in self.objects)
        return Scene(objects=objects, provenance=self.provenance, **fields)


Record = TypeVar("Record", bound=SceneJson)


def scene_record(scene: Scene) -> dict[str, Any]:
    """Return what is no array of a scene, as JSON values, and the version that this needs."""
    maps = maps_of(scene)
    return {
        "schema_version": SCHEMA_VERSION if maps is None else MAPS_VERSION,
        "objects": [dataclasses.asdict(entry) for entry in scene.objects],
        "provenance": dict(scene.provenance),
        **({} if maps is None else {"maps": maps.json}),
    }


def read_scene_record(
    text: bytes | str, kind: type[Record], what: str, versions: Sequence[int] = READABLE_VERSIONS
) -> Record:
    """Return the record of a scene from its JSON text, called `what` in messages.

    Fields that are unknown here are ignored. Texts may hold lone surrogates, as names of files that
    are no UTF-8 do; the reader of types takes none, so it sees `?` in their place.

    Raises:
        TrilightError: no record of this kind, another schema version, or none of MAPS_VERSION
            exactly where the record names maps.
    """
    try:
        raw = json.loads(text)
        if isinstance(raw, dict):
            known = {field.name for field in dataclasses.fields(kind)}
            raw = {name: value for name, value in raw.items() if name in known}
        readable = json.dumps(raw, ensure_ascii=False).encode(errors="replace")
    except (ValueError, RecursionError) as error:
        raise TrilightError(f"{what} is not JSON ({error}).") from error
    record = read_versioned(readable, kind, what, versions)
    if (record.schema_version == MAPS_VERSION) != (record.maps is not None):
        has = "does not name" if record.maps is None else "names"
        raise TrilightError(
            f"{what} {has} maps and has schema version {record.schema_version}; expected "
            f"{MAPS_VERSION} exactly where there are any."
        )
    with_texts = {name: raw[name] for name in ("objects", "provenance", "maps") if name in raw}
    return _as_stored(record, with_texts)


def _as_stored(checked: Any, raw: Any) -> Any:
    """Return a checked value with what the JSON value `raw` holds in its place."""
    if isinstance(checked, tuple):
        return tuple(map(_as_stored, checked, raw))
    if dataclasses.is_dataclass(checked) and not isinstance(checked, type):
        fields = {name: _as_stored(getattr(checked, name), raw[name]) for name in raw}
        return dataclasses.replace(checked, **fields)
    return raw


def _arrays(scene: Scene) -> tuple[dict[str, NDArray], str | None]:
    """Return the arrays of a scene, and what a file says of their material columns."""
    fields = {name: getattr(scene, name) for name in (*ARRAY_FIELDS, *MAP_ARRAYS)}
    columns = stored_columns(scene.materials)
    fields["materials"] = chosen_columns(scene.materials, columns)
    arrays = {name: np.ascontiguousarray(each) for name, each in fields.items() if each is not None}
    return arrays, stored_names(columns)


def _maps(record: SceneJson, arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """Return the fields `textures` and `environment` of what a file says, where it has any."""
    if record.maps is None:
        return {}
    if len(record.is_srgb) != len(record.maps.textures):
        wrong_value("is_srgb", list(record.is_srgb), "true or false for each texture")

    def load(kind: Any, entry: MapEntry, row: int) -> Any:
        is_texture = kind is Texture
        name = f"{_TEXTURE}{row}" if is_texture else _ENVIRONMENT
        if name not in arrays:
            raise TrilightError(f"scene: the array {name} is missing.")
        is_srgb = is_texture and record.is_srgb[row]
        return checked_map(kind, entry, held_values(arrays[name]), is_srgb=is_srgb)

    return record.maps.load(load)


def _check_names(arrays: Mapping[str, NDArray]) -> None:
    """Refuse arrays that are not a scene's, and maps that would take too much memory."""
    maps = {name for name in arrays if name == _ENVIRONMENT or name.startswith(_TEXTURE)}
    unexpected = (arrays.keys() - maps - MAP_ARRAYS.keys()) ^ ARRAY_FIELDS.keys()
    if unexpected or len(maps) > MAX_TEXTURES + 1:
        names = ", ".join(f"{name!r:.60}" for name in sorted(unexpected)[:3])
        raise TrilightError(f"scene: arrays missing or not expected: {names}.")
    # half floats take twice their size in memory
    total = sum(arrays[name].size * (1 if arrays[name].dtype == np.uint8 else 4) for name in maps)
    if total > MAX_MAPS_BYTES:
        wrong_value("textures and environment", f"{total} bytes", f"at most {MAX_MAPS_BYTES}")
