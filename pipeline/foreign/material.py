"""`SourceMaterial`: a material as its file states it, and its conversion to Trilight's columns.

The Fresnel term becomes albedos that are the same at every angle (storage.optics).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.mesh import TriangleMesh
from pipeline.foreign.picture import Picture
from storage.optics import constant_albedos

RGB = tuple[float, float, float]

WHITE: RGB = (1.0, 1.0, 1.0)

MOST_UV_SETS = 4
"""Maximum number of texture coordinate sets of a mesh that are read."""

LEAST_ROUGHNESS = 0.01
"""Least roughness, the same as that of sampled materials (scene_templates.sample_material)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Slot:
    """A picture with its placement on texture coordinates."""

    picture: Picture
    uv_set: int = 0
    """Index of the mesh's texture coordinate set."""
    uv_matrix: NDArray[np.float64] = field(default_factory=lambda: np.eye(2))
    """[2, 2] matrix that those coordinates, v up, are multiplied with first."""
    uv_offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """[2] offset added after the matrix, v up."""
    channel: int = 0
    """Index of the channel that holds a single number."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceMaterial:
    """A material in the metallic-roughness or the specular workflow; factors are linear."""

    base_rgb: RGB = WHITE
    base: Slot | None = None
    """Base color picture, sRGB-encoded, multiplied with `base_rgb`."""
    metallic: float = 0.0
    roughness: float = 1.0
    metallic_map: Slot | None = None
    roughness_map: Slot | None = None
    """Roughness picture, as `metallic_map` linear, in one channel, multiplied with its factor."""
    f0: float = 0.04
    """Reflectance at normal incidence, before `specular_rgb` and `specular_strength`."""
    specular_rgb: RGB = WHITE
    specular_colour: Slot | None = None
    """Specular color picture, sRGB-encoded, multiplied with `specular_rgb`."""
    specular_strength: float = 1.0
    specular_strength_map: Slot | None = None
    """Linear picture, in alpha, multiplied with `specular_strength`."""
    has_fresnel: bool = True
    """False where the surface reflects the same at every angle, as Trilight's own materials do."""
    glossiness: Slot | None = None
    """Linear picture of the specular workflow: roughness is 1 - (1 - roughness) x alpha."""
    emission_rgb: RGB = (0.0, 0.0, 0.0)
    emission: Slot | None = None
    """Emission picture, sRGB-encoded, multiplied with `emission_rgb`; it has no column."""
    normal: Slot | None = None
    """Normal map, linear: right, up and out where texture coordinates grow; None where there is
    none, or none is read."""
    normal_scale: RGB = (2.0, 2.0, 2.0)
    normal_bias: RGB = (-1.0, -1.0, -1.0)
    """Factor and offset that make vectors of the picture's values."""
    lost: tuple[str, ...] = ()
    """Names of stated features that have no place here, such as transparency."""

    @property
    def emits(self) -> bool:
        """Return whether the emission factor is not zero."""
        return any(self.emission_rgb)

    @property
    def column_slots(self) -> dict[str, Slot]:
        """The slots that have a picture, by their names in `source_columns`."""
        slots = {
            "base": self.base,
            "metallic": self.metallic_map,
            "roughness": self.roughness_map,
            "specular_colour": self.specular_colour,
            "specular_strength": self.specular_strength_map,
            "glossiness": self.glossiness,
        }
        return {name: slot for name, slot in slots.items() if slot is not None}

    @property
    def slots(self) -> list[Slot]:
        """All slots that have a picture."""
        more = (self.emission, self.normal)
        return [*self.column_slots.values(), *(slot for slot in more if slot is not None)]


def with_normal_map(
    material: SourceMaterial, slot: Slot, strength: float = 1.0, *, lost: tuple[str, ...] = ()
) -> SourceMaterial:
    """Return a material with a normal map that is read; `lost` names what still is not."""
    unread = tuple(word for word in material.lost if word != "normal map")
    return replace(
        material,
        normal=slot,
        normal_scale=(2 * strength, 2 * strength, 2.0),
        normal_bias=(-strength, -strength, -1.0),
        lost=tuple(sorted({*unread, *lost})) if lost else unread,
    )


def source_columns(
    material: SourceMaterial,
    samples: Mapping[str, NDArray[np.float32]],
    count: int,
    *,
    least_roughness: float = LEAST_ROUGHNESS,
) -> NDArray[np.float64]:
    """Return diffuse rgb, specular rgb and roughness [N, 7] at `count` places.

    `samples` holds values [N, 4] of pictures at those places, by `SourceMaterial.column_slots`.
    """

    def scale(factor: object, name: str, channels: slice) -> NDArray:
        factors = np.broadcast_to(
            np.asarray(factor, np.float64), (count, channels.stop - channels.start)
        )
        return factors * samples[name][:, channels] if name in samples else factors

    def scale_channel(factor: float, name: str, slot: Slot | None) -> NDArray:
        channel = 0 if slot is None else slot.channel
        return scale(factor, name, slice(channel, channel + 1))

    base = np.clip(scale(material.base_rgb, "base", slice(0, 3)), 0, 1)
    rough = scale_channel(material.roughness, "roughness", material.roughness_map)
    metal = np.clip(scale_channel(material.metallic, "metallic", material.metallic_map), 0, 1)
    if "glossiness" in samples:
        rough = 1 - (1 - material.roughness) * samples["glossiness"][:, 3:4]
    tint = scale(material.specular_rgb, "specular_colour", slice(0, 3))
    strength = scale(material.specular_strength, "specular_strength", slice(3, 4))
    dielectric = np.minimum(material.f0 * tint, 1) * strength
    # a surface without reflectance at normal incidence is meant to have no specular lobe at all
    grazing = np.where(dielectric.max(axis=1, keepdims=True) > 0, np.clip(strength, 0, 1), 0)
    specular = dielectric
    diffuse = np.minimum(base, 1 - dielectric)
    if material.has_fresnel:
        diffuse, specular = constant_albedos(base, metal, dielectric, grazing)
    return np.concatenate([diffuse, specular, np.clip(rough, least_roughness, 1)], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class TexturedMesh:
    """The triangles of a source, those of `load_mesh`, with their materials."""

    mesh: TriangleMesh
    material: NDArray[np.int64]
    """[F] index into `materials` of each face."""
    materials: Sequence[SourceMaterial]
    uv: NDArray[np.float64]
    """[F, S, 3, 2] texture coordinates of corners by set S, v up; NaN where there are none."""
    tangent: NDArray[np.float64] | None = None
    """[F, 3, 4] tangent of each corner, and the sign of its bitangent, where the file states them;
    NaN where it does not."""
    color: NDArray[np.float64] | None = None
    """[F, 3, 3] linear tint of each corner, multiplied with the base color; None for white."""
