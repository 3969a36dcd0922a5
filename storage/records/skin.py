"""`LevelSkin`: what a level of an asset looks like in its own colours, and how well that is known.

The textures are an atlas of the level's own triangles, baked from the source
(pipeline.assets.source_materials), so that they need no charts and survive any change of the
triangles. Each is packed as in a shard (storage.records.packed_maps), since a run holds many
objects and shows few of them at a time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from storage.records.packed_maps import unpack_texture
from storage.records.texture import NORMAL, TEXTURED, Texture

SkinTextures = tuple[Texture, Texture, Texture]
"""Diffuse, specular and roughness; one texel in float32 where one is the same everywhere."""


@dataclass(frozen=True, kw_only=True)
class SkinQuality:
    """Color errors of a level against its source."""

    colour_error: float
    """Mean difference of the linear diffuse colour between points spread evenly over the source and
    the nearest points of the level, over all channels."""
    colour_error_p95: float
    """95th percentile of the same error."""
    missed_cells: float
    """Share of the texels for which the source has no surface nearby that faces the same way: they
    show its nearest point."""
    torn_seams: float
    """Share of the length of inner edges whose two sides show places of the source that are more
    than two texels apart."""
    texels_per_length: float
    """Texels along the longest side of the object's bounding box."""


@dataclass(frozen=True, kw_only=True)
class OwnMaterials:
    """Result of reading a source's materials."""

    reason: str = ""
    """Stable code of why the object goes without them; empty where it has them."""
    message: str = ""
    """One sentence for a person."""
    lost: tuple[str, ...] = ()
    """Properties of the source that this renderer cannot show, such as `emission`."""

    @property
    def see_through(self) -> tuple[str, ...]:
        """Those of `lost` by which light passes through surfaces, which are opaque here."""
        return tuple(word for word in self.lost if word in ("transmission", "transparency"))


@dataclass(frozen=True, kw_only=True, eq=False)
class LevelSkin:
    """The look of one level."""

    uv: NDArray[np.float32]
    """[F, 3, 2] texture coordinates of each corner of each face, within [0, 1], v up."""
    packed: tuple[bytes, bytes, bytes]
    """Encoded bytes of the three textures."""
    packed_normal: bytes | None = None
    """Encoded bytes of the normal map; None where the source has none, or it was not requested."""
    quality: SkinQuality
    """Errors measured against the source."""
    emission: NDArray[np.float32] | None = None
    """[F, 3] what each face emits, in the units of the source; None where nothing does, or
    where it was not requested."""

    @cached_property
    def textures(self) -> SkinTextures:
        """Diffuse, specular and roughness, unpacked."""
        first, second, third = map(unpack_texture, self.packed, TEXTURED)
        return first, second, third

    @cached_property
    def normal(self) -> Texture | None:
        """The normal map, unpacked."""
        return None if self.packed_normal is None else unpack_texture(self.packed_normal, NORMAL)

    @property
    def num_bytes(self) -> int:
        """Bytes as they are stored."""
        glow = 0 if self.emission is None else self.emission.nbytes
        return self.uv.nbytes + sum(map(len, (*self.packed, self.packed_normal or b""))) + glow


def skin_arrays(skin: LevelSkin, name: str) -> dict[str, NDArray]:
    """Return the arrays of a skin for the file of its asset; `name` ends the name of each."""
    maps: dict[str, NDArray] = {
        f"{column}_{name}": np.frombuffer(data, np.uint8)
        for column, data in zip(TEXTURED, skin.packed, strict=True)
    }
    if skin.packed_normal is not None:
        maps[f"{NORMAL}_{name}"] = np.frombuffer(skin.packed_normal, np.uint8)
    if skin.emission is not None:
        maps[f"emission_{name}"] = np.ascontiguousarray(skin.emission)
    return {f"uv_{name}": np.ascontiguousarray(skin.uv), **maps}


def read_skin(arrays: Mapping[str, NDArray], quality: SkinQuality, name: str) -> LevelSkin:
    """Return the skin of `skin_arrays`; raises KeyError where there is none."""
    first, second, third = (arrays[f"{column}_{name}"].tobytes() for column in TEXTURED)
    normal = arrays.get(f"{NORMAL}_{name}")
    return LevelSkin(
        uv=arrays[f"uv_{name}"],
        packed=(first, second, third),
        packed_normal=None if normal is None else normal.tobytes(),
        quality=quality,
        emission=arrays.get(f"emission_{name}"),
    )
