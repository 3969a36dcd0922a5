"""What a file says of a surface, and what that is in Trilight's columns.

Its Fresnel term becomes albedos that are the same at every angle (storage.optics.fresnel).
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.foreign.picture import Picture
from storage.optics.fresnel import constant_albedos

RGB = tuple[float, float, float]

WHITE: RGB = (1.0, 1.0, 1.0)

MOST_UV_SETS = 4
"""Sets of texture coordinates of a mesh that are looked at."""

LEAST_ROUGHNESS = 0.01
"""As of drawn materials (scene_templates.materials)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Slot:
    """A picture where a material has it."""

    picture: Picture
    """What is shown."""
    uv_set: int = 0
    """Which of the mesh's coordinates it lies on."""
    turn: NDArray[np.float64] = field(default_factory=lambda: np.eye(2))
    """[2, 2] applied to those coordinates first,"""
    shift: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """[2] and then added; both with v up."""
    channel: int = 0
    """Which channel of the picture a number is in."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceMaterial:
    """A material in the metallic-roughness or the specular workflow; factors are linear."""

    base_rgb: RGB = WHITE
    base: Slot | None = None
    """sRGB-encoded; times `base_rgb`."""
    metallic: float = 0.0
    roughness: float = 1.0
    metallic_map: Slot | None = None
    roughness_map: Slot | None = None
    """Linear: each in its channel, times its factor."""
    f0: float = 0.04
    """What a dielectric reflects head-on, before the two below."""
    specular_rgb: RGB = WHITE
    specular_colour: Slot | None = None
    """sRGB-encoded; times `specular_rgb`."""
    specular_strength: float = 1.0
    specular_strength_map: Slot | None = None
    """Linear, in alpha; times `specular_strength`."""
    glossiness: Slot | None = None
    """Linear, in alpha: roughness is 1 - (1 - roughness) x alpha. Of the specular workflow."""
    emission_rgb: RGB = (0.0, 0.0, 0.0)
    emission: Slot | None = None
    """sRGB-encoded; times `emission_rgb`. No column: it becomes light where that is asked for."""
    lost: tuple[str, ...] = ()
    """What else it says."""

    @property
    def emits(self) -> bool:
        """Whether it says that it does."""
        return any(self.emission_rgb)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The pictures that it has."""
        found = (
            self.base,
            self.metallic_map,
            self.roughness_map,
            self.specular_colour,
            self.specular_strength_map,
            self.glossiness,
            self.emission,
        )
        return tuple(slot for slot in found if slot is not None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """What the pictures of a material show at N places; None where it has no such picture."""

    base: NDArray[np.float32] | None
    metallic: NDArray[np.float32] | None
    roughness: NDArray[np.float32] | None
    specular_colour: NDArray[np.float32] | None
    specular_strength: NDArray[np.float32] | None
    glossiness: NDArray[np.float32] | None


def columns(
    material: SourceMaterial, seen: Seen, count: int, *, least_roughness: float = LEAST_ROUGHNESS
) -> NDArray[np.float64]:
    """Return diffuse rgb, specular rgb and roughness [N, 7] of `count` places."""

    def times(factor: object, found: NDArray[np.float32] | None, part: slice) -> NDArray:
        whole = np.broadcast_to(np.asarray(factor, np.float64), (count, part.stop - part.start))
        return whole if found is None else whole * found[:, part]

    def number(factor: float, found: NDArray[np.float32] | None, slot: Slot | None) -> NDArray:
        channel = 0 if slot is None else slot.channel
        return times(factor, found, slice(channel, channel + 1))

    base = np.clip(times(material.base_rgb, seen.base, slice(0, 3)), 0, 1)
    rough = number(material.roughness, seen.roughness, material.roughness_map)
    metal = np.clip(number(material.metallic, seen.metallic, material.metallic_map), 0, 1)
    if seen.glossiness is not None:
        rough = 1 - (1 - material.roughness) * seen.glossiness[:, 3:4]
    colour = times(material.specular_rgb, seen.specular_colour, slice(0, 3))
    strength = times(material.specular_strength, seen.specular_strength, slice(3, 4))
    dielectric = np.minimum(material.f0 * colour, 1) * strength
    # what reflects nothing head-on is meant to have no lobe at all
    grazing = np.where(dielectric.max(axis=1, keepdims=True) > 0, np.clip(strength, 0, 1), 0)
    diffuse, specular = constant_albedos(base, metal, dielectric, grazing)
    return np.concatenate([diffuse, specular, np.clip(rough, least_roughness, 1)], axis=1)
