"""Textured materials, multiple scattering and skies as Mitsuba plugins, stock ones and our own.

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
from functools import cache, partial
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from storage.optics import MIN_ALPHA, ROUGHNESS_STEPS, X_STEPS, Smith, albedo_table, mean_albedo
from storage.records.material import laid_out
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED, Environment

PLUGIN = "compensated_specular"
"""Name in scene dictionaries; it has the textures specular, again (Fms) and alpha."""

_WIDTH = "squared_roughness"
_AGAIN: dict[Smith, str] = {smith: f"scattered_again_{smith}" for smith in get_args(Smith)}
_LEAST_COS = 1e-4
"""Only rays along the surface are below; the lookup divides by the cosine."""


def textured_slots(scene: Scene, row: int, smith: Smith) -> dict[str, Any]:
    """Return the textures of a material row by their names in `plugin_scene`.

    Args:
        scene: that has textures.
        row: of its materials.
        smith: of the specular lobe.
    """
    diffuse, specular, roughness = (_texels(scene, row, name) for name in TEXTURED)
    most, mirrored = diffuse.max(), specular.max()
    weight = mirrored / (most + mirrored) if most + mirrored > 0 else 0.0
    alpha = {"type": _WIDTH, "roughness": _bitmap(roughness)}
    return {
        "diffuse": _bitmap(diffuse / (1 - weight) if weight < 1 else diffuse),
        "specular": _bitmap(specular / weight if weight > 0 else specular),
        "alpha": alpha,
        "weight": _bitmap(np.full((1, 1, 1), weight)),
        "again": {"type": _AGAIN[smith], "specular": _bitmap(specular), "alpha": alpha},
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
    for smith in get_args(Smith):
        _register(_AGAIN[smith], partial(_scattered_again, smith), "specular", "alpha")
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


def _scattered_again(smith: Smith, si: Any, active: Any, specular: Any, alpha: Any) -> Any:
    place = _texel_coordinate(dr.sqrt(alpha.eval_1(si, active)), ROUGHNESS_STEPS)
    mean, color = _mean_table(smith).eval(mi.Point1f(place))[0], specular.eval(si, active)
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
