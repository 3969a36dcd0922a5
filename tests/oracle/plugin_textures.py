"""Textured materials, multiple scattering and skies as Mitsuba plugins, stock ones and our own.

A texture goes into a `bitmap` as it is: Mitsuba has v = 0 at the first row of a bitmap that a mesh
of arrays is given, which is the bottom row here. Values are linear, hence `raw`. Share and widths
of the lobes are no bilinear functions of the textures: the share is a constant here (any will do),
the GGX width is squared after the lookup, and multiple scattering is found from both.

The scale of storage.optics.multiscatter depends on the direction of the viewer, which no stock
texture reads; one of our own may. `roughconductor` has the separable Smith term, so the table is
that one's: from every direction the surface returns as much light as in the kernel, but the shape
of a rough lobe differs (0.6 % of direct light at roughness 0.6, 4.5 % at 1, root mean square).

A sky is an `envmap`. Mitsuba has its axes turned by a cyclic permutation: the middle of its picture
is +Z, a quarter from the left is +X, the top is +Y. And its first and last rows lie on the poles,
where ours are half a texel from them. Rows between ours, of which each is the mean of its
neighbours, make both the same function: its interpolation between them is ours.
"""

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from storage.optics.bsdf import MIN_ALPHA
from storage.optics.multiscatter import ROUGHNESS_STEPS, X_STEPS, Smith, albedo_table, mean_albedo
from storage.records.environment import Environment
from storage.records.material import laid_out
from storage.records.scene import Scene
from storage.records.texture import CONSTANT, TEXTURED

_WIDTH, _AGAIN = "squared_roughness", "scattered_again"


def textured_slots(scene: Scene, row: int, smith: Smith) -> dict[str, Any]:
    """Return the textures of a material row by their names in `plugin_scene`.

    Args:
        scene: that has textures.
        row: of its materials.
        smith: of the specular lobe.
    """
    _register()
    diffuse, specular, roughness = (_texels(scene, row, name) for name in TEXTURED)
    most, mirrored = diffuse.max(), specular.max()
    weight = mirrored / (most + mirrored) if most + mirrored > 0 else 0.0
    alpha = {"type": _WIDTH, "roughness": _bitmap(roughness)}
    return {
        "diffuse": _bitmap(diffuse / (1 - weight) if weight < 1 else diffuse),
        "specular": _bitmap(specular / weight if weight > 0 else specular),
        "alpha": alpha,
        "weight": _bitmap(np.full((1, 1, 1), weight)),
        "again": {"type": _AGAIN, "smith": smith, "specular": _bitmap(specular), "alpha": alpha},
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
def _register() -> None:
    """Make both textures known to Mitsuba; a variant must be set, and stays for the process."""
    _register_width()
    _register_again()


def _register_width() -> None:
    class SquaredRoughness(mi.Texture):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self._roughness = properties.get_texture("roughness")

        def eval_1(self, si: Any, active: Any = True) -> Any:
            return dr.maximum(dr.square(self._roughness.eval_1(si, active)), MIN_ALPHA)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(self.eval_1(si, active))

        def mean(self) -> Any:
            return dr.square(self._roughness.mean())

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture(_WIDTH, SquaredRoughness)


def _register_again() -> None:
    class ScatteredAgain(mi.Texture):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self._specular = properties.get_texture("specular")
            self._alpha = properties.get_texture("alpha")
            widths = np.square(np.linspace(0, 1, ROUGHNESS_STEPS))
            means = mean_albedo(widths, properties["smith"])
            linear: Any = mi.Texture1f
            self._means = linear(
                mi.TensorXf(means.astype(np.float32)[:, None]), wrap_mode=dr.WrapMode.Clamp
            )

        def eval(self, si: Any, active: Any = True) -> Any:
            roughness = dr.sqrt(self._alpha.eval_1(si, active))
            # The centre of texel k of n lies at (k + 0.5) / n.
            place = (roughness * (ROUGHNESS_STEPS - 1) + 0.5) / ROUGHNESS_STEPS
            mean = self._means.eval(mi.Point1f(place))[0]
            specular = self._specular.eval(si, active)
            return specular * mean / (1 - specular * (1 - mean))

        def mean(self) -> Any:
            return self._specular.mean()

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture(_AGAIN, ScatteredAgain)


PLUGIN = "compensated_specular"
"""Name in scene dictionaries; it has the textures specular, again (Fms) and alpha."""

_LEAST_COS = 1e-4
"""Only rays along the surface are below; the lookup divides by the cosine."""


@cache
def register_plugin() -> None:
    """Make PLUGIN known to Mitsuba; a variant must be set, and stays for the process."""

    class CompensatedSpecular(mi.Texture):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self._specular = properties.get_texture("specular")
            self._again = properties.get_texture("again")
            self._alpha = properties.get_texture("alpha")
            texels = mi.TensorXf(albedo_table("separable").astype(np.float32)[..., None])
            bilinear: Any = mi.Texture2f
            self._table = bilinear(texels, wrap_mode=dr.WrapMode.Clamp)

        def eval(self, si: Any, active: Any = True) -> Any:
            place = _place_in_table(si.wi.z, self._alpha.eval_1(si, active))
            albedo = self._table.eval(place)[0]
            more = self._again.eval(si, active) * ((1 - albedo) / albedo)
            return self._specular.eval(si, active) * (1 + more)

        def mean(self) -> Any:
            return self._specular.mean()

        def is_spatially_varying(self) -> bool:
            return True

    mi.register_texture(PLUGIN, CompensatedSpecular)


def _place_in_table(cosine: Any, alpha: Any) -> Any:
    cosine = dr.maximum(cosine, _LEAST_COS)
    cos_sq = cosine * cosine
    stretched = cosine * dr.rsqrt(cos_sq + alpha * alpha * (1 - cos_sq))
    # The centre of texel k of n lies at (k + 0.5) / n.
    u = (dr.sqrt(stretched) * (X_STEPS - 1) + 0.5) / X_STEPS
    v = (dr.sqrt(alpha) * (ROUGHNESS_STEPS - 1) + 0.5) / ROUGHNESS_STEPS
    return mi.Point2f(u, v)


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
