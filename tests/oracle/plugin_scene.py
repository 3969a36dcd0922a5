"""A `Scene` as stock Mitsuba plugins, for either variant.

One mesh holds all surfaces, with the material as attributes of its faces; in a textured scene each
material row has one, with its textures. Emitters reflect by the same material. They are one shape
per material row and side: Mitsuba's `area` emitter has one side, so each triangle has a turned
twin, and both are moved apart, or rays would meet either of two
coincident faces at random and half of the emission would be lost.
"""

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.light_tables import lamp_power, sky_share
from pipeline.renders.tracer import split_triangles
from storage.optics import Lobes, Smith, bsdf_lobes, scattered_again
from storage.records.lights import shining_sky
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.oracle.plugin_textures import (
    PLUGIN,
    normal_mapped,
    plugin_sky,
    register_textures,
    textured_slots,
)

_TWIN_OFFSET = 1e-4
"""World units between a twin and the emitter itself: ten times what shadow rays stop short."""


def _face(name: str) -> dict[str, str]:
    return {"type": "mesh_attribute", "name": f"face_{name}"}


_SLOTS = ("weight", "diffuse", "specular", "alpha", "again")
_SMITH: Smith = "separable"


def _blend(textures: dict[str, Any]) -> dict[str, Any]:
    """Return diffuse and specular lobe as the blend of storage.optics."""
    specular = {name: textures[name] for name in ("specular", "again", "alpha")}
    return {
        "type": "blendbsdf",
        "weight": textures["weight"],
        "first": {"type": "diffuse", "reflectance": textures["diffuse"]},
        "second": {
            "type": "roughconductor",
            "material": "none",
            "distribution": "ggx",
            "alpha": textures["alpha"],
            "specular_reflectance": {"type": PLUGIN, **specular},
        },
    }


def scaled_albedos(lobes: Lobes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return d/(1 - w) and s/w, [T, 3] each, 0 where the lobe has no share."""
    weight = lobes.weight[:, None]
    zeros = np.zeros_like(lobes.diffuse)
    diffuse = np.divide(lobes.diffuse, 1 - weight, out=zeros.copy(), where=weight < 1)
    specular = np.divide(lobes.specular, weight, out=zeros, where=weight > 0)
    return diffuse, specular


def _material(scene: Scene, row: int) -> Any:
    """Return the BSDF of a mesh: of one material row in textured scenes, read from faces else."""
    if scene.textures:
        return _two_sided(normal_mapped(scene, row, _blend(textured_slots(scene, row, _SMITH))))
    return _two_sided(_blend({name: _face(name) for name in _SLOTS}))


def plugin_scene(scene: Scene) -> Any:
    """Return the mi.Scene of everything."""
    register_textures()
    _, emitters = split_triangles(scene)
    shapes = _shapes(scene, _surfaces)
    sky = shining_sky(scene)
    if sky is not None:
        share = sky_share(scene, sky)
        weight = lamp_power(scene) * share / (1 - share) if share < 1 else 1.0
        # Its lamps are two-sided twins, each of which has the power of the lamp.
        shapes["sky"] = plugin_sky(sky, 2 * weight)
    for row in np.unique(scene.material_index[emitters]):
        triangles = emitters[scene.material_index[emitters] == row]
        for side in (1, -1):
            shapes[f"emitter_{row}_{side}"] = _emitter(scene, triangles, side)
    return mi.load_dict({"type": "scene", **shapes})


def plugin_feature_scene(scene: Scene) -> Any:
    """Return the mi.Scene of the surfaces alone, with diffuse + specular as its albedo."""
    return mi.load_dict({"type": "scene", **_shapes(scene, _feature_surfaces)})


def _shapes(scene: Scene, mesh_of: Callable[[Scene, NDArray[np.intp], int], Any]) -> dict[str, Any]:
    """Return the meshes of surfaces: one of all, or in textured scenes one for a material row."""
    triangles, _ = split_triangles(scene)
    rows = scene.material_index[triangles] if scene.textures else np.zeros_like(triangles)
    return {
        f"surfaces_{row}": mesh_of(scene, triangles[rows == row], int(row))
        for row in np.unique(rows)
    }


def _surfaces(scene: Scene, triangles: NDArray[np.intp], row: int) -> Any:
    mesh = _mesh(scene, triangles, _material(scene, row))
    _add_material(mesh, scene, triangles)
    return mesh


def _feature_surfaces(scene: Scene, triangles: NDArray[np.intp], row: int) -> Any:
    lobes = bsdf_lobes(scene.materials[scene.material_index[triangles]])
    mesh = _mesh(scene, triangles, _two_sided({"type": "diffuse", "reflectance": _face("albedo")}))
    _add_attribute(mesh, "albedo", lobes.diffuse + lobes.specular)
    return mesh


def _add_material(mesh: Any, scene: Scene, triangles: NDArray[np.intp]) -> None:
    """Give the faces of a mesh what `_material` reads from them: textured ones read no face."""
    if scene.textures:
        return
    lobes = bsdf_lobes(scene.materials[scene.material_index[triangles]])
    diffuse, specular = scaled_albedos(lobes)
    _add_attribute(mesh, "weight", lobes.weight[:, None])
    _add_attribute(mesh, "alpha", lobes.alpha[:, None])
    _add_attribute(mesh, "diffuse", diffuse)
    _add_attribute(mesh, "specular", specular)
    _add_attribute(mesh, "again", scattered_again(lobes.specular, lobes.alpha, _SMITH))


def _emitter(scene: Scene, triangles: NDArray[np.intp], side: int) -> Any:
    """Return the shape of emitting triangles of one material row, lit on one side."""
    corners = scene.vertex_positions[scene.faces[triangles]].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1, keepdims=True)
    normal = np.divide(cross, doubled_area, out=np.zeros_like(cross), where=doubled_area > 0)
    radiance = scene.materials[scene.material_index[triangles[0]], EMISSION].astype(np.float64)
    power = 0.5 * float(doubled_area.sum()) * float(radiance.mean())
    properties = mi.Properties()
    properties["bsdf"] = _material(scene, int(scene.material_index[triangles[0]]))
    colour = {"type": "rgb", "value": radiance.tolist()}
    area = {"type": "area", "radiance": colour, "sampling_weight": power}
    properties["emitter"] = mi.load_dict(area)
    twin = corners[:, ::side] + side * _TWIN_OFFSET * normal[:, None]
    vertices = {"positions": twin.reshape(-1, 3)}
    if scene.uv is not None:
        vertices["texcoords"] = scene.uv.reshape(-1, 3, 2)[triangles, ::side].reshape(-1, 2)
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = _build_mesh(f"emitter{side}", faces, properties, **vertices)
    _add_material(mesh, scene, triangles)
    return mesh


def _mesh(scene: Scene, triangles: NDArray[np.intp], material: Any) -> Any:
    """Return triangles as a mesh; corners have texture coordinates of their own, if any."""
    faces = scene.faces[triangles]
    vertices = {"positions": scene.vertex_positions, "normals": scene.vertex_normals}
    if scene.uv is not None:
        vertices = {name: rows[faces.ravel()] for name, rows in vertices.items()}
        vertices["texcoords"] = scene.uv.reshape(-1, 3, 2)[triangles].reshape(-1, 2)
        faces = np.arange(faces.size, dtype=np.uint32).reshape(-1, 3)
    properties = mi.Properties()
    properties["bsdf"] = material
    return _build_mesh("surfaces", faces, properties, **vertices)


def _build_mesh(name: str, faces: NDArray[Any], properties: Any, **rows: NDArray[Any]) -> Any:
    has = {f"has_vertex_{field}": field in rows for field in ("normals", "texcoords")}
    mesh = mi.Mesh(name, len(rows["positions"]), len(faces), props=properties, **has)
    parameters = mi.traverse(mesh)
    for field, each in rows.items():
        parameters[f"vertex_{field}"] = each.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _two_sided(material: dict[str, Any]) -> Any:
    return mi.load_dict({"type": "twosided", "material": material})


def _add_attribute(mesh: Any, name: str, values: NDArray[np.float64]) -> None:
    flat = np.ascontiguousarray(values, np.float32).ravel()
    mesh.add_attribute(f"face_{name}", values.shape[1], flat)
