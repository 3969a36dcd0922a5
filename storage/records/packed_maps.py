"""Textures and environment maps as bytes.

A map is packed alone, as one gzip stream of a safetensors file with one array: equal content gives
equal bytes, whatever it is called. Float32 values that half floats hold exactly are stored so.

In a shard every map stands once, as a member `__map-<sha256>__` before the first sample that uses
it. WebDataset skips names of this form, and other readers names without a point: strangers see
samples as before. Nothing in a header decides how much memory is taken.
"""

import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.errors import TrilightError
from storage.records.environment import Environment
from storage.records.held_maps import HeldMaps, Map
from storage.records.map_references import (
    checked_environment,
    checked_texture,
    described_environment,
    described_texture,
    environment_entries,
    map_member,
    texture_entries,
    wrong_map,
)
from storage.records.safe_read import read_safetensors, safetensors_header
from storage.records.scene import Scene
from storage.records.texture import MAX_MAPS_BYTES, Texture

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
