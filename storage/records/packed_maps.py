"""Textures and environment maps as bytes.

A map is packed alone, as one gzip stream of a safetensors file with one array: equal content gives
equal bytes, whatever it is called. Float32 values that half floats hold exactly are stored so.

In a shard every map stands once, as a member `__map-<sha256>__` before the first sample that uses
it. WebDataset skips names of this form, and other readers names without a point: strangers see
samples as before. Nothing in a header decides how much memory is taken. The record of a scene has
one entry `maps`: the sha256 of each, with its name and rights, and how the environment is turned.
"""

import dataclasses
import re
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.safe_read import read_safetensors, safetensors_header
from storage.records.scene import Scene
from storage.records.scene_maps import MAX_TEXTURES
from storage.records.texture import MAX_MAPS_BYTES, MapSource, Texture

HELD_BYTES = 1 << 26
"""Most bytes that the maps of all open shards of a set take: 40 skies of 512 x 256 texels in
float32, or 340 colours of 256 x 256 in 8 bits."""

Map = TypeVar("Map", Texture, Environment)

_Key = tuple[type, str, str]
"""What a map is said to be and to hold, and the digest of the bytes that it was unpacked from."""


class HeldMaps:
    """The most recently used maps, unpacked and checked; for several threads at once.

    They go by the very bytes that they were unpacked from: bytes that are refused once are refused
    again, in any order of samples and shards. Arrays may not be written to: several samples share
    them.
    """

    def __init__(self, most_bytes: int = HELD_BYTES) -> None:
        """Hold nothing yet.

        Args:
            most_bytes: of all maps together; a larger map is not held.
        """
        self._most = most_bytes
        self._maps: OrderedDict[_Key, Any] = OrderedDict()
        self._lock = threading.Lock()
        self.num_bytes = 0
        """Of the arrays that are held."""

    def get_or_unpack(
        self, kind: type[Map], sha256: str, packed: bytes, unpack: Callable[[], Map]
    ) -> Map:
        """Return the map of some bytes: the held one, or what `unpack` returns, then held.

        Two threads that miss the same map both unpack it.

        Args:
            kind: what it is said to be.
            sha256: of the content that it is said to have.
            packed: what it is unpacked from.
            unpack: makes the map, and raises unless it is lawful and has this content.
        """
        key = kind, sha256, sha256_hex(packed)
        with self._lock:
            if key in self._maps:
                self._maps.move_to_end(key)
                known: Map = self._maps[key]
                return known
        made = unpack()
        _array(made).flags.writeable = False
        with self._lock:
            self._hold(key, made)
        return made

    def _hold(self, key: _Key, made: Texture | Environment) -> None:
        num_bytes = _array(made).nbytes
        if num_bytes > self._most or key in self._maps:
            return
        while self.num_bytes + num_bytes > self._most:
            _, oldest = self._maps.popitem(last=False)
            self.num_bytes -= _array(oldest).nbytes
        self._maps[key] = made
        self.num_bytes += num_bytes


def _array(one: Texture | Environment) -> Any:
    return one.texels if isinstance(one, Texture) else one.radiance_rgb


def with_same_content(one: Map, **changes: Any) -> Map:
    """Return a map with another name or turn; what was computed of its content stays known."""
    other = dataclasses.replace(one, **changes)
    vars(other).update({**vars(one), **vars(other)})
    return other


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


_ARRAY = "values"
_FORM = "form"
_SRGB = "srgb"
_LINEAR = "linear"
_ENVIRONMENT = "environment"
_DTYPES = {"U8": np.uint8, "F16": np.float16, "F32": np.float32}
_MOST_HEADER = 1 << 10
_GZIP = 31


def packed_maps(scene: Scene) -> dict[str, bytes]:
    """Return the bytes of a scene's maps by the names of their members."""
    packed = {map_member(texture.sha256): pack_texture(texture) for texture in scene.textures}
    if scene.environment is not None:
        packed[map_member(scene.environment.sha256)] = pack_environment(scene.environment)
    return packed


def pack_texture(texture: Texture) -> bytes:
    """Return the bytes of a texture."""
    return _pack(stored_values(texture.texels), _SRGB if texture.is_srgb else _LINEAR)


def unpack_texture(data: bytes, name: str) -> Texture:
    """Return the texture of `pack_texture`, called `name` in messages.

    Raises:
        TrilightError: no texture, damaged, or larger than MAX_MAPS_BYTES.
    """
    packed_map = _PackedMap(data, name)
    if packed_map.form not in (_SRGB, _LINEAR) or packed_map.num_bytes_held > MAX_MAPS_BYTES:
        wrong_map(name, packed_map.form, f"a texture of at most {MAX_MAPS_BYTES} bytes")
    texture = Texture(texels=packed_map.values(), is_srgb=packed_map.form == _SRGB)
    texture.check(name)
    return texture


def pack_environment(environment: Environment) -> bytes:
    """Return the bytes of an environment's map, however it is turned."""
    return _pack(stored_values(environment.radiance_rgb), _ENVIRONMENT)


def stored_values(values: NDArray) -> NDArray:
    """Return values as they are stored: float32 as half floats where these hold all of them."""
    if values.dtype != np.float32:
        return values
    with np.errstate(over="ignore"):
        halves = values.astype(np.float16)
    return halves if np.array_equal(halves.astype(np.float32), values) else values


def held_values(stored: NDArray) -> NDArray:
    """Return values as they are held in memory: the inverse of `stored_values`."""
    return stored.astype(np.float32) if stored.dtype == np.float16 else stored


def unpacked_maps(
    maps: Any, members: Mapping[str, bytes], held: HeldMaps | None = None
) -> dict[str, Any]:
    """Return the fields `textures` and `environment` of a scene, whose arrays are read-only.

    Args:
        maps: what `maps_record` gave, from outside.
        members: bytes of the maps by the names of their members; others are ignored.
        held: those of other samples, which are not unpacked again; None where there is no other.

    Raises:
        TrilightError: not of that form, a map is missing or damaged, all of them take more than
            MAX_MAPS_BYTES, or one has another content than its name says.
    """
    entries = texture_entries(maps)
    skies = environment_entries(maps)
    packed: dict[str, bytes] = {}
    for entry in (*entries, *skies):
        if (name := map_member(entry["sha256"])) not in members:
            raise TrilightError(
                f"scene: map {entry['sha256']} is missing; expected a member {name} before the "
                "sample. Run `trilight verify`."
            )
        packed[name] = members[name]
    total = sum(_PackedMap(data, name).num_bytes_held for name, data in packed.items())
    if total > MAX_MAPS_BYTES:
        wrong_map("maps", f"{total} bytes", f"at most {MAX_MAPS_BYTES}")
    held = HeldMaps() if held is None else held
    fields: dict[str, Any] = {}
    if entries:
        fields["textures"] = tuple(
            described_texture(entry, _load_map(Texture, entry, packed, held, _texture))
            for entry in entries
        )
    for entry in skies:
        sky = _load_map(Environment, entry, packed, held, _environment)
        fields["environment"] = described_environment(entry, sky)
    return fields


def _load_map(
    kind: type[Map],
    entry: Mapping[str, Any],
    packed: Mapping[str, bytes],
    held: HeldMaps,
    unpack: Callable[[Mapping[str, Any], bytes], Map],
) -> Map:
    data = packed[map_member(entry["sha256"])]
    return held.get_or_unpack(kind, entry["sha256"], data, lambda: unpack(entry, data))


def _texture(entry: Mapping[str, Any], packed: bytes) -> Texture:
    packed_map = _PackedMap(packed, f"map {entry['sha256']}")
    if packed_map.form not in (_SRGB, _LINEAR):
        wrong_map(packed_map.name, packed_map.form, "a texture")
    return checked_texture(entry, packed_map.values(), is_srgb=packed_map.form == _SRGB)


def _environment(entry: Mapping[str, Any], packed: bytes) -> Environment:
    packed_map = _PackedMap(packed, f"map {entry['sha256']}")
    if packed_map.form != _ENVIRONMENT:
        wrong_map(packed_map.name, packed_map.form, "an environment map")
    return checked_environment(entry, packed_map.values())


def _pack(values: NDArray, form: str) -> bytes:
    packer = zlib.compressobj(level=6, wbits=_GZIP)
    data = save({_ARRAY: np.ascontiguousarray(values)}, {_FORM: form})
    return packer.compress(data) + packer.flush()


class _PackedMap:
    """A packed map of which only the header was read: it says how many bytes there will be."""

    def __init__(self, data: bytes, name: str) -> None:
        self.name = name
        self._data = data
        header = safetensors_header(self._unpack(8 + _MOST_HEADER), _MOST_HEADER, name=name)
        entry = header.get(_ARRAY)
        metadata = header.get("__metadata__")
        if set(header) != {_ARRAY, "__metadata__"} or not isinstance(entry, Mapping):
            wrong_map(name, sorted(header), f"one array {_ARRAY}")
        shape = entry.get("shape")
        dtype = entry.get("dtype")
        if (
            not isinstance(shape, list)
            or len(shape) != 3
            or not all(type(side) is int and 0 < side <= MAX_MAPS_BYTES for side in shape)
            or dtype not in _DTYPES
        ):
            wrong_map(name, [dtype, shape], "a picture of 8 bits or floats")
        self.form = str(metadata.get(_FORM)) if isinstance(metadata, Mapping) else ""
        count = shape[0] * shape[1] * shape[2]
        self.num_bytes_held = count * (1 if dtype == "U8" else 4)
        self._num_bytes = count * np.dtype(_DTYPES[dtype]).itemsize

    def values(self) -> NDArray:
        """Return the array as it is held in memory."""
        data = self._unpack(8 + _MOST_HEADER + self._num_bytes, require_end=True)
        arrays, _ = read_safetensors(data, _MOST_HEADER, name=self.name)
        return held_values(arrays[_ARRAY])

    def _unpack(self, most: int, *, require_end: bool = False) -> bytes:
        unpacker = zlib.decompressobj(wbits=_GZIP)
        try:
            data = unpacker.decompress(self._data, most)
        except zlib.error as error:
            raise TrilightError(f"{self.name}: damaged.") from error
        if require_end and (not unpacker.eof or unpacker.unused_data):
            raise TrilightError(f"{self.name}: cut short, or goes on after its end.")
        return data
