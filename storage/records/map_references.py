"""References of a scene's record to its textures and maps, by their content.

The record has one entry `maps`: the sha256 of each, with its name and rights, and how the
environment is turned. Bytes are elsewhere (storage.records.packed_maps).
"""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.held_maps import with_same_content
from storage.records.scene import Scene
from storage.records.scene_maps import MAX_TEXTURES
from storage.records.texture import MapSource, Texture

MAP_NAME = re.compile(r"__map-([0-9a-f]{64})__")
"""Name of a map among the members of a shard."""

_SOURCE_FIELDS = tuple(field.name for field in dataclasses.fields(MapSource))


def map_member(sha256: str) -> str:
    """Return the name of a map among the members of a shard."""
    return f"__map-{sha256}__"


def maps_record(scene: Scene) -> dict[str, Any] | None:
    """Return what a scene's record says of its maps, as JSON values; None where it has none."""
    record: dict[str, Any] = {}
    if scene.textures:
        record["textures"] = [
            {"sha256": texture.sha256, **dataclasses.asdict(texture.source)}
            for texture in scene.textures
        ]
    if (sky := scene.environment) is not None:
        record["environment"] = {
            "sha256": sky.sha256,
            "rotation": sky.rotation.tolist(),
            "is_seen": sky.is_seen,
            **dataclasses.asdict(sky.source),
        }
    return record or None


def maps_digest(record: Mapping[str, Any]) -> NDArray[np.uint8]:
    """Return [32] the sha256 of what `maps_record` says, without names and rights.

    It stands among the arrays of the scene, whose digest so covers what its surfaces look like.
    """
    identity = {
        "textures": [entry["sha256"] for entry in record.get("textures", ())],
        "environment": {
            name: value
            for name, value in record.get("environment", {}).items()
            if name not in _SOURCE_FIELDS
        },
    }
    return np.frombuffer(bytes.fromhex(sha256_hex(canonical_json(identity))), np.uint8)


def referenced_maps(record: Any) -> list[str]:
    """Return the member names of the maps that a scene's record names, each once.

    Raises:
        TrilightError: the record's entry `maps` is not of the form of `maps_record`.
    """
    if not isinstance(record, Mapping) or "maps" not in record:
        return []
    entries = [*texture_entries(record["maps"]), *environment_entries(record["maps"])]
    return list(dict.fromkeys(map_member(entry["sha256"]) for entry in entries))


def checked_texture(entry: Mapping[str, Any], texels: NDArray, *, is_srgb: bool) -> Texture:
    """Return the texture of some texels; raises where it is not what an entry names."""
    texture = Texture(texels=texels, is_srgb=is_srgb, source=_source(entry))
    texture.check(f"texture {entry['sha256']}")
    _require_content(texture.sha256, entry)
    return texture


def checked_environment(entry: Mapping[str, Any], radiance_rgb: NDArray) -> Environment:
    """Return an unturned environment; raises where its map is not what an entry names."""
    environment = Environment(radiance_rgb=radiance_rgb)
    environment.check()
    _require_content(environment.sha256, entry)
    return environment


def described_texture(entry: Mapping[str, Any], texture: Texture) -> Texture:
    """Return a texture with the name and rights that an entry of `maps_record` says."""
    source = _source(entry)
    return texture if texture.source == source else with_same_content(texture, source=source)


def described_environment(entry: Mapping[str, Any], sky: Environment) -> Environment:
    """Return an environment as an entry of `maps_record` names and turns it.

    Raises:
        TrilightError: the turn is no rotation.
    """
    environment = with_same_content(
        sky,
        rotation=np.array(entry["rotation"], np.float64).astype(np.float32),
        is_seen=entry["is_seen"],
        source=_source(entry),
    )
    environment.check()
    return environment


def texture_entries(maps: Any) -> Sequence[Mapping[str, Any]]:
    """Return what a record says of its textures; raises as `referenced_maps`."""
    if not isinstance(maps, Mapping) or not set(maps) <= {"textures", "environment"}:
        wrong_map("maps", maps, "textures, environment, or both")
    entries = maps.get("textures", [])
    if not isinstance(entries, list) or len(entries) > MAX_TEXTURES:
        wrong_map("maps.textures", entries, f"a list of at most {MAX_TEXTURES}")
    for row, entry in enumerate(entries):
        _check_entry(entry, f"maps.textures[{row}]", ())
    return entries


def environment_entries(maps: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """Return the entry of the environment, or none; raises as `referenced_maps`."""
    if "environment" not in maps:
        return ()
    entry = maps["environment"]
    _check_entry(entry, "maps.environment", ("rotation", "is_seen"))
    rotation = entry["rotation"]
    is_seen = entry["is_seen"]
    if type(is_seen) is not bool:
        wrong_map("maps.environment.is_seen", is_seen, "true or false")
    rows = rotation if isinstance(rotation, list) else []
    numbers = [number for row in rows if isinstance(row, list) for number in row]
    if [len(row) for row in rows if isinstance(row, list)] != [3, 3, 3] or not all(
        type(number) in (int, float) and abs(number) < 2 for number in numbers
    ):
        wrong_map("maps.environment.rotation", rotation, "three rows of three numbers")
    return (entry,)


def _check_entry(entry: Any, name: str, more: Sequence[str]) -> None:
    fields = {"sha256", *_SOURCE_FIELDS, *more}
    if not isinstance(entry, Mapping) or set(entry) != fields:
        wrong_map(name, entry, f"exactly the fields {', '.join(sorted(fields))}")
    for field in ("sha256", *_SOURCE_FIELDS):
        if not isinstance(entry[field], str):
            wrong_map(f"{name}.{field}", entry[field], "text")
    if not MAP_NAME.fullmatch(map_member(entry["sha256"])):
        wrong_map(f"{name}.sha256", entry["sha256"], "64 hexadecimal digits")


def _source(entry: Mapping[str, Any]) -> MapSource:
    return MapSource(**{name: entry[name] for name in _SOURCE_FIELDS})


def _require_content(sha256: str, entry: Mapping[str, Any]) -> None:
    if sha256 != entry["sha256"]:
        raise TrilightError(
            f"scene: map {entry['sha256']} has the content {sha256}; expected that of its name. "
            "Run `trilight verify`."
        )


def wrong_map(name: str, got: Any, expected: str) -> NoReturn:
    """Raise TrilightError for something of a map."""
    raise TrilightError(f"scene: {name} is {got!r:.80}; expected {expected}.")
