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
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.conventions import (
    MAPS_VERSION,
    READABLE_VERSIONS,
    SCHEMA_VERSION,
    require_readable,
)
from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.material import chosen_columns, completed_rows, stored_columns, stored_names
from storage.records.packed_maps import (
    Entry,
    Map,
    checked_map,
    described_map,
    held_values,
    map_entries,
    maps_digest,
    maps_record,
    stored_values,
)
from storage.records.retextured import without_constant_textures
from storage.records.safe_read import read_safetensors
from storage.records.scene import (
    ARRAY_FIELDS,
    MAP_ARRAYS,
    MAX_TEXTURES,
    OBJECT_KINDS,
    Scene,
    SceneObject,
)
from storage.records.scene_laws import require_fields, wrong_value
from storage.records.texture import MAX_MAPS_BYTES, Texture

MAX_FILE_BYTES = (256 << 20) + MAX_MAPS_BYTES
"""A million triangles with three vertices each take 90 MB."""

MAX_HEADER_BYTES = 8 << 20
"""An object takes 150 bytes and its attribution; there are at most 65,536."""

CARRIED = frozenset(
    {*ARRAY_FIELDS, "objects", "provenance", "textures", "normal_textures", "environment"}
)
"""What the form holds of a scene (pipeline.exchange.formats): all of it, added columns too."""

_VERSIONS = (SCHEMA_VERSION, MAPS_VERSION)
_METADATA = "trilight_scene"
_COLUMNS = "material_columns"
_MAPS = "maps"
_MAPS_DIGEST = "maps_sha256"
_TEXTURE = "texture."
_ENVIRONMENT = "environment"
_IS_SRGB = "is_srgb"


def encode_arrays(scene: Scene) -> bytes:
    """Return the arrays of a scene alone, as the member `scene.safetensors` of a sample.

    Material columns beyond the published ones stand there where they are not at their default; then
    the metadata name all of them.
    """
    scene = without_constant_textures(scene)
    stated = stored_names(stored_columns(scene.materials))
    arrays = _arrays(scene)
    if (maps := maps_record(scene)) is not None:
        arrays[_MAPS_DIGEST] = maps_digest(maps)
    return save(arrays, None if stated is None else {_COLUMNS: stated})


def decode_arrays(data: bytes, maps: Any = None) -> dict[str, NDArray]:
    """Return the array fields of a scene from the bytes of `encode_arrays`.

    Args:
        data: the bytes.
        maps: what the record of the scene says of its maps (storage.records.packed_maps).

    Raises:
        TrilightError: damaged, an array is missing, a material column is not declared here, or the
            arrays are those of a scene with other maps.
    """
    arrays, metadata = read_safetensors(data)
    if missing := set(ARRAY_FIELDS) - set(arrays):
        raise TrilightError(f"scene: the array {min(missing)} is missing.")
    arrays["materials"] = completed_rows(arrays["materials"], metadata.get(_COLUMNS))
    stored_digest = arrays[_MAPS_DIGEST].tobytes() if _MAPS_DIGEST in arrays else None
    if stored_digest != (None if maps is None else maps_digest(maps).tobytes()):
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
    if stated := stored_names(stored_columns(scene.materials)):
        record[_COLUMNS] = stated
    arrays = _arrays(scene)
    if scene.textures:
        record[_IS_SRGB] = [texture.is_srgb for texture in scene.textures]
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
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_FILE_BYTES:
            raise TrilightError(
                f"{path.name}: expected a regular file of at most {MAX_FILE_BYTES} bytes."
            )
        data = path.read_bytes()
    except OSError as error:
        raise TrilightError(f"{path.name}: cannot be read ({error.strerror}).") from error
    return decode_scene_file(data, path.name)


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
    try:
        arrays, metadata = read_safetensors(data, MAX_HEADER_BYTES)
        _check_names(arrays)
        if _METADATA not in metadata:
            raise TrilightError(f"scene: metadata {_METADATA} are missing.")
        record = read_scene_record(metadata[_METADATA], "scene: its record", _VERSIONS)
        arrays["materials"] = completed_rows(arrays["materials"], record.get(_COLUMNS))
        fields = _maps(record, arrays)
        fields |= {name: arrays[name] for name in (*ARRAY_FIELDS, *MAP_ARRAYS) if name in arrays}
        scene = scene_of_record(record, **fields)
        scene.check()
    except TrilightError as error:
        raise TrilightError(f"{name}: {error}") from error
    return scene


def scene_record(scene: Scene) -> dict[str, Any]:
    """Return what is no array of a scene, as JSON values, and the version that this needs."""
    maps = maps_record(scene)
    return {
        "schema_version": SCHEMA_VERSION if maps is None else MAPS_VERSION,
        "objects": [dataclasses.asdict(entry) for entry in scene.objects],
        "provenance": dict(scene.provenance),
        **({} if maps is None else {_MAPS: maps}),
    }


def read_scene_record(
    text: bytes | str, what: str, versions: Sequence[int] = READABLE_VERSIONS
) -> dict[str, Any]:
    """Return the record of a scene from its JSON text, called `what` in messages.

    Raises:
        TrilightError: no JSON, another schema version, or none of MAPS_VERSION exactly where the
            record names maps.
    """
    try:
        record = json.loads(text, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise TrilightError(f"{what} is not JSON ({error}).") from error
    version = record.get("schema_version") if isinstance(record, dict) else None
    require_readable(version, what, versions)
    if (version == MAPS_VERSION) != (_MAPS in record):
        has = "names" if _MAPS in record else "does not name"
        raise TrilightError(
            f"{what} {has} {_MAPS} and has schema version {version}; expected {MAPS_VERSION} "
            "exactly where there are any."
        )
    return dict(record)


def _refuse_constant(text: str) -> float:
    raise TrilightError(f"{text} is no JSON number")


def scene_of_record(record: Mapping[str, Any], **fields: Any) -> Scene:
    """Return the scene of a record and of all other fields; its laws are not checked.

    Raises:
        TrilightError: the objects are no list, one has a field too many or too few, no text or an
            unknown kind; or as `scene_provenance`.
    """
    objects = record.get("objects")
    if not isinstance(objects, list):
        wrong_value("objects", objects, "a list")
    texts = dict.fromkeys((field.name for field in dataclasses.fields(SceneObject)), str)
    for row, entry in enumerate(objects):
        require_fields(entry, f"objects[{row}]", texts)
        if entry["kind"] not in OBJECT_KINDS:
            expected = f"one of {', '.join(OBJECT_KINDS)}"
            wrong_value(f"objects[{row}].kind", entry["kind"], expected)
    provenance = scene_provenance(record.get("provenance"))
    return Scene(
        objects=tuple(SceneObject(**entry) for entry in objects), provenance=provenance, **fields
    )


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


def _arrays(scene: Scene) -> dict[str, NDArray]:
    arrays = {name: np.ascontiguousarray(getattr(scene, name)) for name in ARRAY_FIELDS}
    for name in MAP_ARRAYS:
        if (array := getattr(scene, name)) is not None:
            arrays[name] = np.ascontiguousarray(array)
    columns = stored_columns(scene.materials)
    return arrays | {"materials": chosen_columns(scene.materials, columns)}


def _maps(record: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """Return the fields `textures` and `environment` of what a file says, where it has any."""
    if _MAPS not in record:
        return {}
    textures, skies = map_entries(record[_MAPS])
    is_srgb = record.get(_IS_SRGB, [])
    if not isinstance(is_srgb, list) or [type(each) for each in is_srgb] != [bool] * len(textures):
        wrong_value(_IS_SRGB, is_srgb, "true or false for each texture")

    def load(kind: type[Map], name: str, entry: Entry, *, is_srgb: bool = False) -> Map:
        if name not in arrays:
            raise TrilightError(f"scene: the array {name} is missing.")
        made = checked_map(kind, entry, held_values(arrays[name]), is_srgb=is_srgb)
        return described_map(entry, made)

    fields: dict[str, Any] = {}
    for sky in skies:
        fields[_ENVIRONMENT] = load(Environment, _ENVIRONMENT, sky)
    fields["textures"] = tuple(
        load(Texture, f"{_TEXTURE}{row}", entry, is_srgb=is_srgb[row])
        for row, entry in enumerate(textures)
    )
    return fields


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
