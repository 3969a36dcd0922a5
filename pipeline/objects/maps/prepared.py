"""Prepared textures and maps, as scenes use them.

A child process reads a file once, and the user's cache keeps the outcome under a key of all that it
depends on. The cache keeps no refusal: it costs little, and the user may fix the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from pipeline.foreign.light_pictures import read_linear_picture
from pipeline.objects.maps.names import TEXTURE_PARTS, packed_channels
from pipeline.objects.maps.picture import are_normals, picture_values
from pipeline.objects.maps.radiance import usable_map
from pipeline.objects.maps.texture_set import texture_set
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.records.objects import SKY
from storage.records.safe_read import read_safetensors
from storage.records.texture import content_digest

MOST_BYTES = 1 << 30
"""Largest accepted size of one file, in bytes."""

MOST_ROWS = 4096
"""Largest number of rows of a map; columns are at most twice as many."""

_RECIPE = 3
"""Version of the outcomes; raise it when the result for a file changes."""

_MOST_HEADER = 1 << 12


@dataclass(frozen=True, kw_only=True)
class MapFiles:
    """The files of a texture or map, and its largest size."""

    kind: str
    """Kind of the map: TEXTURE or SKY."""
    files: Mapping[str, Path]
    """Picture files by component; a map has one, "map"."""
    size: int
    """Most texels along a side of a texture; most rows of a map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedMap:
    """A prepared texture or map."""

    content_sha256: str
    """Digest that decides the split: of the base color, or of the whole map, as read."""
    arrays: Mapping[str, NDArray[np.float32]]
    """Arrays: "diffuse", "specular" and optionally "roughness" of a texture; "radiance" of a map.
    """

    def encode(self) -> bytes:
        """Return the bytes of its file."""
        return save(dict(self.arrays), {"content": self.content_sha256})


def decode_prepared(data: bytes, name: str) -> PreparedMap:
    """Decode the bytes of `encode`; raises TrilightError where the file is damaged."""
    arrays, metadata = read_safetensors(data, _MOST_HEADER, name=name)
    return PreparedMap(content_sha256=metadata["content"], arrays=arrays)


def map_cache_key(map_files: MapFiles) -> str:
    """Return the cache key of the outcome: a digest of the files, the size and the recipe.

    Raises:
        Rejected: missing_file, too_large_bytes.
    """
    digests = {part: sha256_hex(_read(path)) for part, path in map_files.files.items()}
    parts = [map_files.kind, digests, map_files.size, _RECIPE]
    return sha256_hex(canonical_json(parts))[:32]


def prepare_map(map_files: MapFiles) -> tuple[bytes, tuple[str, ...]]:
    """Return the file of a texture or map, and notes on unread parts; for child processes.

    Raises:
        Rejected: the reason and a remedy; see `usable_map`, `texture_set` and the readers.
    """
    if map_files.kind == SKY:
        return _prepare_sky(_read(map_files.files["map"]), map_files.size)
    pictures: dict[str, NDArray[np.float32]] = {}
    unread: list[str] = []
    for part, path in sorted(map_files.files.items()):
        values, notes = _picture_of(part, path)
        unread += [f"{note} of its {part}" for note in notes]
        if packed_channels(part) and values.shape[2] < 3:
            unread.append(f"its {part}, which is grey: it has no channels")
        pictures[part] = values
    if "base" in pictures and are_normals(pictures["base"]):
        raise Rejected(
            "unknown_map", "its values are unit vectors, as of a normal map; end it in _normal"
        )
    result = texture_set(unpack_parts(pictures), map_files.size)
    maps = {"diffuse": result.diffuse_rgb, "specular": result.specular_rgb}
    if result.roughness is not None:
        maps["roughness"] = result.roughness
    prepared = PreparedMap(content_sha256=result.content_sha256, arrays=maps)
    return prepared.encode(), tuple(unread)


def _prepare_sky(data: bytes, rows: int) -> tuple[bytes, tuple[str, ...]]:
    picture = read_linear_picture(data, 2 * MOST_ROWS * MOST_ROWS)
    if picture is None:
        raise Rejected("not_hdr", "it is neither an OpenEXR nor a Radiance file; write it again")
    grey = picture.values.shape[2] < 3
    radiance = np.ascontiguousarray(picture.values[..., [0, 0, 0] if grey else [0, 1, 2]])
    prepared = PreparedMap(
        content_sha256=content_digest("radiance", radiance),
        arrays={"radiance": np.ascontiguousarray(usable_map(radiance, rows))},
    )
    return prepared.encode(), picture.unread


def unpack_parts(
    pictures: Mapping[str, NDArray[np.float32]],
) -> Mapping[str, NDArray[np.float32]]:
    """Return the components of a texture; separate pictures win over packed channels."""
    parts = dict(pictures)
    for name, values in pictures.items():
        for part, channel in packed_channels(name).items():
            if part not in parts and values.shape[2] == 3:
                parts[part] = values[..., channel : channel + 1]
    if "gloss" in parts and "roughness" not in parts:
        parts["roughness"] = 1 - parts["gloss"]
    return {part: values for part, values in parts.items() if part in TEXTURE_PARTS}


def _picture_of(part: str, path: Path) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return a picture's values and notes on unread parts; a rejection names the component."""
    try:
        return picture_values(_read(path), is_color=part == "base")
    except Rejected as rejection:
        raise Rejected(rejection.reason, f"{part}: {rejection.message}") from rejection


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise Rejected("missing_file", f"{path.name} is no file")
        if (size := path.stat().st_size) > MOST_BYTES:
            raise Rejected("too_large_bytes", f"{size} bytes; expected at most {MOST_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise Rejected("missing_file", f"cannot be read ({error.strerror})") from error
