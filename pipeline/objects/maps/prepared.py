"""Prepared textures and maps: what one file became, as scenes use it.

A file is read once, in a child, and its outcome is kept in the user's cache under a name that says
what it depends on. A refusal is not kept: it costs little, and the file may be mended.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from pipeline.objects.maps.picture import picture_values
from pipeline.objects.maps.radiance import usable_map
from pipeline.objects.maps.rgbe import rgbe_radiance
from pipeline.objects.maps.texture_set import texture_set
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected, TrilightError
from storage.records.exr import channel_names, decode_channels
from storage.records.objects import SKY
from storage.records.safe_read import read_safetensors
from storage.records.texture import content_digest

MOST_BYTES = 1 << 30
"""Most bytes of one file."""

MOST_ROWS = 4096
"""Most rows of a map, and half of its most columns."""

_RECIPE = 1
"""To be raised when what is made of a file changes."""

_MOST_HEADER = 1 << 12


@dataclass(frozen=True, kw_only=True)
class MapFiles:
    """What a texture or map is made of, and how large it may be."""

    kind: str
    """TEXTURE or SKY."""
    files: Mapping[str, Path]
    """By part; a map has one, "map"."""
    size: int
    """Most texels along a side of a texture; most rows of a map."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedMap:
    """An outcome."""

    content_sha256: str
    """Digest of what decides the split: the base colour, or the whole map, as it was read."""
    arrays: Mapping[str, NDArray[np.float32]]
    """Of a texture "diffuse", "specular" and perhaps "roughness"; of a map "radiance"."""

    def encoded(self) -> bytes:
        """Return the file of it."""
        return save(dict(self.arrays), {"content": self.content_sha256})


def decode_prepared(data: bytes, name: str) -> PreparedMap:
    """Return what `encoded` wrote; raises TrilightError where the file is damaged."""
    arrays, metadata = read_safetensors(data, _MOST_HEADER, name=name)
    return PreparedMap(content_sha256=metadata["content"], arrays=arrays)


def outcome_name(asked: MapFiles) -> str:
    """Return the name of the outcome: of the bytes of the files, the size and the recipe.

    Raises:
        Rejected: missing_file, too_large_bytes.
    """
    digests = {part: sha256_hex(_read(path)) for part, path in asked.files.items()}
    parts = [asked.kind, digests, asked.size, _RECIPE]
    return sha256_hex(canonical_json(parts))[:32]


def prepare_map(asked: MapFiles) -> bytes:
    """Return the file of a texture or map; only children come here.

    Raises:
        Rejected: the reason, and what the user can do; see `usable_map`, `texture_set` and the
            readers.
    """
    if asked.kind == SKY:
        path = asked.files["map"]
        radiance = _radiance(_read(path), path.suffix.lower())
        content, arrays = (
            content_digest("radiance", np.ascontiguousarray(radiance)),
            {"radiance": np.ascontiguousarray(usable_map(radiance, asked.size))},
        )
        return PreparedMap(content_sha256=content, arrays=arrays).encoded()
    made = texture_set(
        {part: _named(part, path) for part, path in sorted(asked.files.items())}, asked.size
    )
    maps = {"diffuse": made.diffuse_rgb, "specular": made.specular_rgb}
    if made.roughness is not None:
        maps["roughness"] = made.roughness
    return PreparedMap(content_sha256=made.content_sha256, arrays=maps).encoded()


def _named(part: str, path: Path) -> NDArray[np.float32]:
    """Return the values of a picture; a rejection says which part it was."""
    try:
        return picture_values(_read(path))
    except Rejected as rejection:
        raise Rejected(rejection.reason, f"{part}: {rejection.message}") from rejection


def _radiance(data: bytes, suffix: str) -> NDArray[np.float32]:
    if suffix == ".hdr":
        return rgbe_radiance(data, MOST_ROWS)
    try:
        names = channel_names(data)
        channels = decode_channels(data, names, lambda header: None, separate=True)
    except TrilightError as error:
        raise Rejected("load_error", f"{error} Scale or write it anew.") from error
    for wanted in ("RGB", "YYY"):
        if set(wanted) <= set(names):
            return np.stack([channels[name] for name in wanted], axis=-1).astype(np.float32)
    raise Rejected("load_error", f"its channels are {', '.join(names)[:80]}; expected R, G and B")


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise Rejected("missing_file", f"{path.name} is no file")
        if (size := path.stat().st_size) > MOST_BYTES:
            raise Rejected("too_large_bytes", f"{size} bytes; expected at most {MOST_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise Rejected("missing_file", f"cannot be read ({error.strerror})") from error
