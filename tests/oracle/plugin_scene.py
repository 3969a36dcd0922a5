"""A `Scene` as stock Mitsuba plugins, for either variant, and textures of our own.

One mesh holds all surfaces, with the material as attributes of its faces; in a textured scene each
material row has one, with its textures. Emitters reflect by the same material. They are one shape
per material row and side: Mitsuba's `area` emitter has one side, so each triangle has a turned
twin, and both are moved apart, or rays would meet either of two
coincident faces at random and half of the emission would be lost.

A texture goes into a `bitmap` as it is: Mitsuba has v = 0 at the first row of a bitmap that a mesh
of arrays is given, which is the bottom row here. Values are linear, hence `raw`. Share and widths
of the lobes are no bilinear functions of the textures: the share is a constant here (any will do),
the GGX width is squared after the lookup, and multiple scattering is found from both.

The scale of storage.optics depends on the direction of the viewer, which no stock
texture reads; one of our own may. `roughconductor` has the separable Smith term, so the table is
that one's: from every direction the surface returns as much light as in the kernel, but the shape
of a rough lobe differs (0.6 % of direct light at roughness 0.6, 4.5 % at 1, root mean square).

A sky is an `envmap`. Mitsuba has its axes turned by a cyclic permutation: the middle of its picture
is +Z, a quarter from the left is +X, the top is +Y. And its first and last rows lie on the poles,
where ours are half a texel from them. Rows between ours, of which each is the mean of its
neighbours, make both the same function: its interpolation between them is ours.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.light_tables import lamp_power, sky_share
from pipeline.renders.tracer import split_triangles
from storage.optics import (
    MIN_ALPHA,
    ROUGHNESS_STEPS,
    X_STEPS,
    Lobes,
    Smith,
    albedo_table,
    bsdf_lobes,
    mean_albedo,
    scattered_again,
)
from storage.records.lights import shining_sky
from storage.records.material import EMISSION, laid_out
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Environment

PLUGIN = "compensated_specular"
"""Name in scene dictionaries; it has the textures specular, again (Fms) and alpha."""

_WIDTH = "squared_roughness"
_AGAIN = "scattered_again"
_LEAST_COS = 1e-4
"""Only rays along the surface are below; the lookup divides by the cosine."""

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
        return _two_sided(normal_mapped(scene, row, _blend(textured_slots(scene, row))))
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


def textured_slots(scene: Scene, row: int) -> dict[str, Any]:
    """Return the textures of a material row of a textured scene, by their names in `_blend`."""
    diffuse, specular, roughness = (_texels(scene, row, name) for name in TEXTURED)
    most, mirrored = diffuse.max(), specular.max()
    weight = mirrored / (most + mirrored) if most + mirrored > 0 else 0.0
    alpha = {"type": _WIDTH, "roughness": _bitmap(roughness)}
    return {
        "diffuse": _bitmap(diffuse / (1 - weight) if weight < 1 else diffuse),
        "specular": _bitmap(specular / weight if weight > 0 else specular),
        "alpha": alpha,
        "weight": _bitmap(np.full((1, 1, 1), weight)),
        "again": {"type": _AGAIN, "specular": _bitmap(specular), "alpha": alpha},
    }


def normal_mapped(scene: Scene, row: int, material: dict[str, Any]) -> dict[str, Any]:
    """Return a material below Mitsuba's `normalmap`, where its row has a normal map.

    Without its shadowing function, which darkens what no surface shadows; Trilight has none.
    """
    if scene.normal_textures is None or scene.normal_textures[row] == CONSTANT:
        return material
    texture = scene.textures[scene.normal_textures[row]]
    bitmap = _bitmap(texture.linear(texture.texels).astype(np.float64))
    below = {"normalmap": bitmap, "bsdf": material, "use_shadowing_function": False}
    return {"type": "normalmap", **below}


def _texels(scene: Scene, row: int, name: str) -> NDArray[np.float64]:
    """Return the linear values [H, W, C] of a column, of one texel where it is a constant."""
    assert scene.material_textures is not None
    place = scene.material_textures[row, TEXTURED.index(name)]
    if place == CONSTANT:
        part = next(part for column, part in laid_out() if column.name == name)
        return scene.materials[row, part].reshape(1, 1, -1).astype(np.float64)
    texture = scene.textures[place]
    return texture.linear(texture.texels).astype(np.float64)


def _bitmap(texels: NDArray[np.float64]) -> dict[str, Any]:
    values = np.ascontiguousarray(texels, np.float32)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(values),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
    }


@cache
def register_textures() -> None:
    """Make our textures known to Mitsuba; a variant must be set, and stays for the process."""
    _register(_WIDTH, _squared_roughness, "roughness", mean=dr.square)
    _register(_AGAIN, _scattered_again, "specular", "alpha")
    _register(PLUGIN, _compensated_specular, "specular", "again", "alpha")


def _register(
    name: str,
    value: Callable[..., Any],
    *inputs: str,
    mean: Callable[[Any], Any] = lambda mean: mean,
) -> None:
    """Make a texture known whose value, and mean by that of the first, go by other textures."""

    class OfTextures(mi.Texture):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self._inputs = [properties.get_texture(each) for each in inputs]

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return value(si, active, *self._inputs)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(self.eval_1(si, active))

        def mean(self) -> Any:
            return mean(self._inputs[0].mean())

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture(name, OfTextures)


def _squared_roughness(si: Any, active: Any, roughness: Any) -> Any:
    return dr.maximum(dr.square(roughness.eval_1(si, active)), MIN_ALPHA)


def _scattered_again(si: Any, active: Any, specular: Any, alpha: Any) -> Any:
    place = _texel_coordinate(dr.sqrt(alpha.eval_1(si, active)), ROUGHNESS_STEPS)
    mean, color = _mean_table(_SMITH).eval(mi.Point1f(place))[0], specular.eval(si, active)
    return color * mean / (1 - color * (1 - mean))


def _compensated_specular(si: Any, active: Any, specular: Any, again: Any, alpha: Any) -> Any:
    width, cosine = alpha.eval_1(si, active), dr.maximum(si.wi.z, _LEAST_COS)
    stretched = cosine * dr.rsqrt(dr.square(cosine) + dr.square(width) * (1 - dr.square(cosine)))
    u = _texel_coordinate(dr.sqrt(stretched), X_STEPS)
    v = _texel_coordinate(dr.sqrt(width), ROUGHNESS_STEPS)
    albedo = _albedo_table().eval(mi.Point2f(u, v))[0]
    return specular.eval(si, active) * (1 + again.eval(si, active) * ((1 - albedo) / albedo))


def _texel_coordinate(share: Any, steps: int) -> Any:
    """Return where a table has a number from 0 to 1: the centre of texel k is (k + 0.5) / steps."""
    return (share * (steps - 1) + 0.5) / steps


@cache
def _mean_table(smith: Smith) -> Any:
    means = mean_albedo(np.square(np.linspace(0, 1, ROUGHNESS_STEPS)), smith)
    linear: Any = mi.Texture1f
    return linear(mi.TensorXf(means.astype(np.float32)[:, None]), wrap_mode=dr.WrapMode.Clamp)


@cache
def _albedo_table() -> Any:
    texels = mi.TensorXf(albedo_table("separable").astype(np.float32)[..., None])
    bilinear: Any = mi.Texture2f
    return bilinear(texels, wrap_mode=dr.WrapMode.Clamp)


_TO_OUR_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""X becomes Y, Y becomes Z, Z becomes X."""


def plugin_sky(sky: Environment, sampling_weight: float) -> Any:
    """Return the emitter, picked with a weight beside those of other emitters."""
    to_world = np.eye(4)
    to_world[:3, :3] = sky.rotation.astype(np.float64) @ _TO_OUR_AXES
    return mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(from_pole_to_pole(sky.radiance_rgb)),
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "sampling_weight": sampling_weight,
        }
    )


def from_pole_to_pole(radiance_rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a map [H, W, 3] as rows [2 H + 1, W, 3] at equal steps, from +Z to -Z."""
    rows = np.zeros((2 * len(radiance_rgb) + 1, *radiance_rgb.shape[1:]), np.float32)
    rows[1::2] = radiance_rgb
    rows[2:-1:2] = (radiance_rgb[:-1] + radiance_rgb[1:]) / 2
    rows[0], rows[-1] = radiance_rgb[0], radiance_rgb[-1]
    return rows
