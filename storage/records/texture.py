"""The maps of a scene: `Texture`, and `Environment`, a map (HDRI) of light from far away.

A texture stands in the place of a constant column of a material. It is held as its source has it:
in 8 bits, linear or sRGB-encoded, or in float32. Values are linear after decoding. Row 0 is the
bottom (storage.conventions). Equal content has an equal sha256, by which shards keep every map
once; its name and rights are no part of that.

An environment map is latitude-longitude, linear radiance, with the axes of storage.conventions. A
scene may turn it. A map that is absent costs nothing, and is another thing than a black one that is
seen.
"""

from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.conventions import linear_from_srgb8
from storage.digests import canonical_json, sha256_hex
from storage.records.scene_laws import broken_law, require_array, require_law, require_rotations

TEXTURED = ("diffuse", "specular", "roughness")
"""Names of the columns that a texture can stand for, in the order of `Scene.material_textures`."""

NORMAL = "normal"
"""Name of a normal map among the textures of a material; no column has it."""

CONSTANT = -1
"""In `Scene.material_textures`: the column is what the material row says."""

MAX_SIDE = 16384
"""Most texels along a side."""

MAX_MAPS_BYTES = 1 << 29
"""Most bytes of all textures and of the environment map of one scene, as they are held. A map of
8192 x 4096 texels in float32 takes 403 MB."""


@dataclass(frozen=True, kw_only=True)
class MapSource:
    """Identity and rights of a texture or a map."""

    name: str = ""
    """Name as documents and pages show it."""
    licence: str = "CC0-1.0"
    """SPDX identifier, or `LicenseRef-...`; what is drawn from a seed is ours, hence CC0."""
    attribution: str = ""
    """Author to credit, as the source states it."""
    source_url: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Texture:
    """A picture that repeats along u and v."""

    texels: NDArray[np.uint8] | NDArray[np.float32]
    """[H, W, C] with C of 3 for a colour and 1 for a number, row 0 at the bottom; uint8 stands for
    [0, 1]."""
    is_srgb: bool = False
    """True: the 8-bit values are sRGB-encoded. float32 is always linear."""
    source: MapSource = field(default_factory=MapSource)

    @property
    def channels(self) -> int:
        return int(self.texels.shape[2])

    @cached_property
    def sha256(self) -> str:
        """Digest of the content: texels as they are held, and how they are read."""
        form = "srgb8" if self.is_srgb else str(self.texels.dtype)
        return content_digest(form, self.texels)

    def linear(self, texels: NDArray) -> NDArray[np.float32]:
        """Return the linear values of texels of this texture, of any shape."""
        if texels.dtype == np.float32:
            return texels
        return _decode_table(self.is_srgb)[texels]

    @cached_property
    def greatest(self) -> NDArray[np.float32]:
        """[C] the greatest linear value of each channel."""
        return self.linear(self.texels.max(axis=(0, 1)))

    @cached_property
    def mean(self) -> NDArray[np.float32]:
        """[C] the mean of the linear values: what stands for the texture where none is read."""
        if self.texels.dtype == np.float32:
            return self.texels.mean(axis=(0, 1), dtype=np.float64).astype(np.float32)
        planes = np.moveaxis(self.texels, -1, 0)
        counts = np.stack([np.bincount(plane.ravel(), minlength=256) for plane in planes])
        table = _decode_table(self.is_srgb).astype(np.float64)
        means: NDArray[np.float64] = counts @ table / planes[0].size
        return means.astype(np.float32)

    @cached_property
    def constant(self) -> NDArray[np.float32] | None:
        """[C] the linear value of every texel; None where they differ."""
        first = self.texels[0, 0]
        return self.linear(first) if (self.texels == first).all() else None

    def check(self, name: str) -> None:
        """Raise TrilightError at the first broken law; `name` stands for the texture."""
        texels = self.texels
        if texels.dtype not in (np.uint8, np.float32):
            broken_law(f"{name} has dtype {texels.dtype}", "uint8 or float32")
        if self.is_srgb and texels.dtype != np.uint8:
            broken_law(f"{name} is sRGB-encoded in {texels.dtype}", "uint8, or linear values")
        if texels.ndim != 3 or texels.shape[2] not in (1, 3):
            broken_law(f"{name} has shape {texels.shape}", "(height, width, 1 or 3)")
        if not all(1 <= side <= MAX_SIDE for side in texels.shape[:2]):
            broken_law(f"{name} has shape {texels.shape}", f"sides of 1 to {MAX_SIDE} texels")
        if texels.dtype == np.float32 and not (texels.min() >= 0 and texels.max() <= 1):  # or NaN
            require_law((texels >= 0) & (texels <= 1), name, texels, "finite values from 0 to 1")


def content_digest(form: str, values: NDArray) -> str:
    """Return the sha256 of an array: of its form and shape, and of its bytes."""
    head = canonical_json({"form": form, "shape": list(values.shape)})
    return sha256_hex(head + np.ascontiguousarray(values).tobytes())


@cache
def _decode_table(is_srgb: bool) -> NDArray[np.float32]:
    """Return the linear value [256] of every 8-bit value."""
    return linear_from_srgb8() if is_srgb else (np.arange(256) / 255).astype(np.float32)


MAX_RADIANCE = 1e9
"""Greatest radiance of a map. A sun of 1e6 is usual; sums over the largest map stay finite."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Environment:
    """A latitude-longitude map of radiance from infinitely far away."""

    radiance_rgb: NDArray[np.float32]
    """[H, 2H, 3] linear radiance; row 0 is the top (+Z of the map)."""
    rotation: NDArray[np.float32] = field(default_factory=lambda: np.eye(3, dtype=np.float32))
    """[3, 3] from the axes of the map to those of the world."""
    is_seen: bool = False
    """True: cameras see the map. It lights the scene in any case."""
    source: MapSource = field(default_factory=MapSource)

    @cached_property
    def sha256(self) -> str:
        """Digest of the map alone: the same map, turned, is the same content."""
        return content_digest("environment", self.radiance_rgb)

    def to_map(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Return directions [..., 3] of the world in the axes of the map."""
        return np.positive(directions, dtype=np.float64) @ self.rotation

    def check(self, called: str = "environment") -> None:
        """Raise TrilightError at the first broken law; `called` stands for the map."""
        radiance = self.radiance_rgb
        name = f"{called}.radiance_rgb"
        require_array(radiance, name, np.float32, (None, None, 3))
        if radiance.shape[1] != 2 * radiance.shape[0]:
            broken_law(f"{name} has shape {radiance.shape}", "(height, twice the height, 3)")
        if not 1 <= radiance.shape[0] <= MAX_SIDE // 2:
            broken_law(f"{name} has shape {radiance.shape}", f"sides of 1 to {MAX_SIDE} texels")
        if not (radiance.min() >= 0 and radiance.max() <= MAX_RADIANCE):  # or NaN
            lawful = (radiance >= 0) & (radiance <= MAX_RADIANCE)
            require_law(lawful, name, radiance, f"finite values from 0 to {MAX_RADIANCE:g}")
        rotation = self.rotation
        require_array(rotation, "environment.rotation", np.float32, (3, 3))
        require_rotations(rotation.T[None], "environment.rotation", rotation[None])


def row_solid_angles(height: int) -> NDArray[np.float64]:
    """Return the steradians [H] of a texel in each row of a map with 2 H columns."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return (edges[:-1] - edges[1:]) * np.pi / height


def texel_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over each texel [H, W] of what interpolation between their centres gives."""
    wide = np.pad(values, ((1, 1), (0, 0)), mode="edge")
    tall = (wide[:-2] + 6 * wide[1:-1] + wide[2:]) / 8
    round_about = np.pad(tall, ((0, 0), (1, 1)), mode="wrap")
    return (round_about[:, :-2] + 6 * round_about[:, 1:-1] + round_about[:, 2:]) / 8
