"""glTF's metal-rough materials as ours: two albedos without a Fresnel term, and a roughness.

glTF reflects more at grazing angles, by Schlick's curve; ours reflects its mean everywhere
(storage.records.fresnel).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.dressed import Worn
from pipeline.exchange.gltf.document import GltfDocument, extension
from pipeline.exchange.gltf.textures import Coordinates, sampled
from pipeline.exchange.linear_maps import (
    Map,
    colour_textures,
    constant_map,
    number_texture,
    on_one_grid,
)
from storage.records.fresnel import constant_albedos
from storage.records.texture import MapSource

_ENCODED = frozenset({"base", "tint"})
_UNDERSTOOD = {"KHR_materials_specular", "KHR_materials_ior", "KHR_materials_emissive_strength"}
_MOST_EMISSION = 1e9


@dataclass(frozen=True, kw_only=True, eq=False)
class GltfLook:
    """A material over one mesh."""

    worn: Worn
    """Its textures, constants too."""
    emission_rgb: NDArray[np.float64]
    """[3] radiance."""
    uv: NDArray[np.float32] | None
    """[T, 3, 2] where textures are looked up; None where all are constants."""


def look_of(
    document: GltfDocument,
    material: dict[str, Any],
    coordinates: Coordinates,
    source: MapSource,
    lost: list[str],
) -> GltfLook:
    """Return what a material of a file comes to on a mesh.

    Args:
        document: the file.
        material: its JSON; empty for glTF's default material.
        coordinates: of the mesh.
        source: name and rights of the textures.
        lost: receives what cannot be carried over.

    Raises:
        TrilightError: a picture is outside of the folder, on the network, or too large.
    """
    surface = material.get("pbrMetallicRoughness", {})
    gloss = extension(material, "KHR_materials_specular")
    stated = {
        "base": surface.get("baseColorTexture"),
        "rough": surface.get("metallicRoughnessTexture"),
        "strength": gloss.get("specularTexture"),
        "tint": gloss.get("specularColorTexture"),
    }
    infos = {name: info for name, info in stated.items() if info is not None}
    found = sampled(document, infos, _ENCODED, coordinates, lost)
    _note_losses(material, lost)
    maps = _inputs(material, found.maps, lost)
    diffuse, specular = _albedos(maps, _head_on(material, lost))
    colours = colour_textures(diffuse, specular, source)
    roughness = number_texture(maps["roughness"], source)
    return GltfLook(
        worn=(*colours, roughness), emission_rgb=_emission(document, material, lost), uv=found.uv
    )


def _inputs(
    material: dict[str, Any], textures: Mapping[str, Map], lost: list[str]
) -> dict[str, Map]:
    """Return base, metal, roughness, strength and tint, each its factor times its texture."""
    surface = material.get("pbrMetallicRoughness", {})
    gloss = extension(material, "KHR_materials_specular")
    base = _factor(surface, "baseColorFactor", (1, 1, 1, 1), lost)[:3]
    found = {
        "base": (base, "base", slice(0, 3)),
        "metal": (_factor(surface, "metallicFactor", 1, lost), "rough", slice(2, 3)),
        "roughness": (_factor(surface, "roughnessFactor", 1, lost), "rough", slice(1, 2)),
        "strength": (_factor(gloss, "specularFactor", 1, lost), "strength", slice(3, 4)),
        "tint": (_factor(gloss, "specularColorFactor", (1, 1, 1), lost, 1e3), "tint", slice(0, 3)),
    }
    return {
        name: constant_map(factor) * textures[use][..., part]
        if use in textures
        else constant_map(factor)
        for name, (factor, use, part) in found.items()
    }


def _albedos(maps: Mapping[str, Map], head_on: float) -> tuple[Map, Map]:
    base, metal, strength, tint = on_one_grid(
        *(maps[name] for name in ("base", "metal", "strength", "tint"))
    )
    f0 = np.minimum(head_on * tint, 1) * strength
    diffuse, specular = constant_albedos(base, metal, f0, strength)
    return diffuse.astype(np.float32), specular.astype(np.float32)


def _head_on(material: dict[str, Any], lost: list[str]) -> float:
    ior = float(_factor(extension(material, "KHR_materials_ior"), "ior", 1.5, lost, 1e3))
    return float(np.square((ior - 1) / (ior + 1))) if ior > 0 else 1.0


def _emission(
    document: GltfDocument, material: dict[str, Any], lost: list[str]
) -> NDArray[np.float64]:
    """Return the radiance of a material; of a texture its mean, since ours is never textured."""
    factor = _factor(material, "emissiveFactor", (0, 0, 0), lost)
    more = extension(material, "KHR_materials_emissive_strength")
    radiance = factor * _factor(more, "emissiveStrength", 1, lost, _MOST_EMISSION)
    if radiance.any() and (info := material.get("emissiveTexture")) is not None:
        found = sampled(document, {"base": info}, _ENCODED, lambda number: None, [])
        if "base" in found.maps:
            radiance = radiance * found.maps["base"].mean(axis=(0, 1))[:3]
            lost.append("textures of emission: their means were taken")
    return np.asarray(radiance, np.float64)


def _factor(
    entry: Mapping[str, Any], name: str, default: Any, lost: list[str], most: float = 1.0
) -> NDArray[np.float64]:
    """Return a number or colour in [0, `most`]; the default, with a note, where it is none."""
    wanted = np.asarray(default, np.float64)
    try:
        found = np.asarray(entry.get(name, default), np.float64)
    except (TypeError, ValueError):
        found = np.full(wanted.shape, np.nan)
    if found.shape != wanted.shape or not np.isfinite(found).all():
        lost.append(f"{name}: no finite number of its kind; {default} taken")
        return wanted
    if found.min() < 0 or found.max() > most:
        lost.append(f"{name}: clamped to [0, {most:g}]")
    return np.clip(found, 0, most)


def _note_losses(material: dict[str, Any], lost: list[str]) -> None:
    if "normalTexture" in material:
        lost.append("normal maps")
    if "occlusionTexture" in material:
        lost.append("occlusion maps: light is traced")
    if material.get("alphaMode", "OPAQUE") != "OPAQUE":
        lost.append(f"transparency (alphaMode {material['alphaMode']!r:.20}): drawn solid")
    lost += [
        f"extension {name!r:.60} of materials"
        for name in material.get("extensions", {})
        if name not in _UNDERSTOOD
    ]
