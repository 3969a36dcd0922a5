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
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from storage.digests import canonical_json, sha256_hex
from storage.errors import TrilightError
from storage.records.safe_read import (
    pack_gzip,
    read_safetensors,
    safetensors_header,
    unpack_gzip,
)
from storage.records.scene import Scene
from storage.records.scene_laws import wrong_value
from storage.records.texture import MAX_MAPS_BYTES, Environment, MapSource, Texture
from storage.settings.ranges import Within
from storage.typed_json import Sha256

HELD_BYTES = 1 << 26
"""Most bytes that the unpacked maps of a process take beside those in use: 40 skies of 512 x 256
texels in float32, or 340 colours of 256 x 256 in 8 bits."""

MAP_NAME = re.compile(r"__map-([0-9a-f]{64})__")
"""Name of a map among the members of a shard."""

Map = TypeVar("Map", Texture, Environment)

_ARRAY = "values"
_FORM = "form"
_FORMS: Mapping[type, Sequence[str]] = {Texture: ("srgb", "linear"), Environment: ("environment",)}
_DTYPES = {"U8": np.uint8, "F16": np.float16, "F32": np.float32}
_MOST_HEADER = 1 << 10


class HeldMaps:
    """The most recently used maps, unpacked and checked; for several threads at once.

    They go by the very bytes that they were unpacked from: bytes that are refused once are refused
    again, in any order of samples and shards. Arrays may not be written to: several samples share
    them.
    """

    def __init__(self) -> None:
        """Hold nothing yet, and at most HELD_BYTES; a larger map is not held."""
        self._maps: OrderedDict[tuple[type, str, str], Any] = OrderedDict()
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
                return self._maps[key]
        made = unpack()
        array = _array(made)
        array.flags.writeable = False
        with self._lock:
            if array.nbytes <= HELD_BYTES and key not in self._maps:
                while self.num_bytes + array.nbytes > HELD_BYTES:
                    _, oldest = self._maps.popitem(last=False)
                    self.num_bytes -= _array(oldest).nbytes
                self._maps[key] = made
                self.num_bytes += array.nbytes
        return made


_HELD = HeldMaps()
"""The maps of this process: samples of all shards that it reads share them."""


def _array(one: Texture | Environment) -> NDArray:
    return one.texels if isinstance(one, Texture) else one.radiance_rgb


def with_same_content(one: Map, **changes: Any) -> Map:
    """Return a map with another name or turn; what was computed of its content stays known."""
    other = dataclasses.replace(one, **changes)
    vars(other).update({**vars(one), **vars(other)})
    return other


def map_member(sha256: str) -> str:
    """Return the name of a map among the members of a shard."""
    return f"__map-{sha256}__"


@dataclass(frozen=True, kw_only=True)
class MapEntry:
    """Entry of a texture in the record of a scene: content, name and rights, all of them stated."""

    sha256: Sha256
    name: str
    licence: str
    attribution: str
    source_url: str


_Component = Annotated[float, Within(-2, 2)]
_Axis = tuple[_Component, _Component, _Component]


@dataclass(frozen=True, kw_only=True)
class SkyEntry(MapEntry):
    """Entry of the environment map, which may be turned."""

    rotation: tuple[_Axis, _Axis, _Axis]
    is_seen: bool


@dataclass(frozen=True, kw_only=True)
class Maps:
    """Entry `maps` in the record of a scene."""

    textures: tuple[MapEntry, ...] = ()
    environment: SkyEntry | None = None

    @property
    def entries(self) -> tuple[MapEntry, ...]:
        """Entries of the textures, and of the environment, if there is one."""
        return self.textures if self.environment is None else (*self.textures, self.environment)

    @property
    def json(self) -> dict[str, Any]:
        """The entry as JSON values, without what there is none of."""
        return {name: each for name, each in dataclasses.asdict(self).items() if each}

    @property
    def digest(self) -> NDArray[np.uint8]:
        """[32] the sha256 of the entry without names and rights.

        It stands among the arrays of the scene, whose digest so covers what its surfaces look like.
        """
        sky = vars(self.environment or MapSource())
        identity = {
            "textures": [entry.sha256 for entry in self.textures],
            "environment": {name: sky[name] for name in sky if name not in vars(MapSource())},
        }
        return np.frombuffer(bytes.fromhex(sha256_hex(canonical_json(identity))), np.uint8)

    def load(self, load: Callable[[Any, MapEntry, int], Any]) -> dict[str, Any]:
        """Return the fields `textures` and `environment` of a scene, where it has any.

        Args:
            load: returns the map of an entry, the n-th of its kind, with any name and turn.

        Raises:
            TrilightError: as `load`, or the turn is no rotation.
        """
        fields: dict[str, Any] = {}
        if (entry := self.environment) is not None:
            rotation = np.array(entry.rotation, np.float64).astype(np.float32)
            turned = {"rotation": rotation, "is_seen": entry.is_seen, "source": _source_of(entry)}
            fields["environment"] = with_same_content(load(Environment, entry, 0), **turned)
            fields["environment"].check()
        if self.textures:
            fields["textures"] = tuple(
                with_same_content(load(Texture, each, row), source=_source_of(each))
                for row, each in enumerate(self.textures)
            )
        return fields


def _source_of(entry: MapEntry) -> MapSource:
    return MapSource(**{name: getattr(entry, name) for name in vars(MapSource())})


def maps_of(scene: Scene) -> Maps | None:
    """Return what a scene's record says of its maps; None where it has none."""
    sky = scene.environment
    if sky is None and not scene.textures:
        return None
    environment = None
    if sky is not None:
        x, y, z = sky.rotation.tolist()
        environment = SkyEntry(
            sha256=sky.sha256, rotation=(x, y, z), is_seen=sky.is_seen, **vars(sky.source)
        )
    textures = (MapEntry(sha256=one.sha256, **vars(one.source)) for one in scene.textures)
    return Maps(textures=tuple(textures), environment=environment)


def checked_map(kind: Any, entry: MapEntry, values: NDArray, *, is_srgb: bool = False) -> Any:
    """Return the unturned map of some values; raises where it is not what an entry names."""
    is_texture = kind is Texture
    made: Texture | Environment = (
        Texture(texels=values, is_srgb=is_srgb) if is_texture else Environment(radiance_rgb=values)
    )
    made.check(f"map {entry.sha256}")
    if made.sha256 != entry.sha256:
        raise TrilightError(
            f"scene: map {entry.sha256} has the content {made.sha256}; expected that of its "
            "name. Run `trilight verify`."
        )
    return made


def packed_maps(scene: Scene) -> dict[str, bytes]:
    """Return the bytes of a scene's maps by the names of their members."""
    skies = () if scene.environment is None else (scene.environment,)
    return {map_member(one.sha256): pack_map(one) for one in (*scene.textures, *skies)}


def pack_map(one: Texture | Environment) -> bytes:
    """Return the bytes of a texture, or of an environment's map, however it is turned."""
    form = _FORMS[type(one)][isinstance(one, Texture) and not one.is_srgb]
    return pack_gzip(
        save({_ARRAY: np.ascontiguousarray(stored_values(_array(one)))}, {_FORM: form})
    )


def unpack_texture(data: bytes, name: str) -> Texture:
    """Return the texture of `pack_map`, called `name` in messages.

    Raises:
        TrilightError: no texture, damaged, or larger than MAX_MAPS_BYTES.
    """
    packed_map = _PackedMap(data, name)
    if packed_map.form not in _FORMS[Texture] or packed_map.num_bytes_held > MAX_MAPS_BYTES:
        wrong_value(name, packed_map.form, f"a texture of at most {MAX_MAPS_BYTES} bytes")
    texture = Texture(texels=packed_map.values(), is_srgb=packed_map.form == "srgb")
    texture.check(name)
    return texture


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


def unpacked_maps(maps: Maps, members: Mapping[str, bytes]) -> dict[str, Any]:
    """Return the fields `textures` and `environment` of a scene, whose arrays are read-only.

    Maps that are held are not unpacked again; equal members give equal scenes with any.

    Args:
        maps: what the record says of them, from outside.
        members: bytes of the maps by the names of their members; others are ignored.

    Raises:
        TrilightError: a map is missing or damaged, all of them take more than MAX_MAPS_BYTES, or
            one has another content than its name says.
    """
    packed: dict[str, _PackedMap] = {}
    for entry in maps.entries:
        if (name := map_member(entry.sha256)) not in members:
            raise TrilightError(
                f"scene: map {entry.sha256} is missing; expected a member {name} before the "
                "sample. Run `trilight verify`."
            )
        packed[name] = _PackedMap(members[name], f"map {entry.sha256}")
    if (total := sum(each.num_bytes_held for each in packed.values())) > MAX_MAPS_BYTES:
        wrong_value("maps", f"{total} bytes", f"at most {MAX_MAPS_BYTES}")

    def load(kind: Any, entry: MapEntry, _: int) -> Any:
        name = map_member(entry.sha256)
        one = packed[name]

        def unpack() -> Any:
            if one.form not in _FORMS[kind]:
                expected = "a texture" if kind is Texture else "an environment map"
                wrong_value(one.name, one.form, expected)
            return checked_map(kind, entry, one.values(), is_srgb=one.form == "srgb")

        return _HELD.get_or_unpack(kind, entry.sha256, members[name], unpack)

    return maps.load(load)


class _PackedMap:
    """A packed map of which only the header was read: it says how many bytes there will be."""

    def __init__(self, data: bytes, name: str) -> None:
        self.name = name
        self._data = data
        head = unpack_gzip(data, 8 + _MOST_HEADER, name, is_whole=False)
        header = safetensors_header(head, _MOST_HEADER, name=name)
        entry = header.get(_ARRAY)
        metadata = header.get("__metadata__")
        if set(header) != {_ARRAY, "__metadata__"} or not isinstance(entry, Mapping):
            wrong_value(name, sorted(header), f"one array {_ARRAY}")
        shape = entry.get("shape")
        dtype = entry.get("dtype")
        if (
            not isinstance(shape, list)
            or len(shape) != 3
            or not all(type(side) is int and 0 < side <= MAX_MAPS_BYTES for side in shape)
            or dtype not in _DTYPES
        ):
            wrong_value(name, [dtype, shape], "a picture of 8 bits or floats")
        self.form = str(metadata.get(_FORM)) if isinstance(metadata, Mapping) else ""
        count = shape[0] * shape[1] * shape[2]
        self.num_bytes_held = count * (1 if dtype == "U8" else 4)
        self._num_bytes = count * np.dtype(_DTYPES[dtype]).itemsize

    def values(self) -> NDArray:
        """Return the array as it is held in memory."""
        data = unpack_gzip(self._data, 8 + _MOST_HEADER + self._num_bytes, self.name)
        arrays, _ = read_safetensors(data, _MOST_HEADER, name=self.name)
        return held_values(arrays[_ARRAY])
