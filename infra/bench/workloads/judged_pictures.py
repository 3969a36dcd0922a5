"""Raw references (infra.render), and stated errors of pictures compared with true ones.

References cost a hundred times the pictures that they judge, and are cached. The cache holds
float32 numbers, and a new reference is rounded to them, too, so that a figure does not depend on
whether its reference was cached.
"""

import numpy as np
from safetensors.numpy import load, save

from infra.render.raw_references import LEAST_ERROR, RawReference, raw_reference, true_error_db
from pipeline.isolation import IsolatedChild
from pipeline.renders.noise_floor import Curve, clamped_radiance, secant_slope
from pipeline.renders.results import RenderedView
from pipeline.renders.tracer import PixelCamera
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.conventions import log10_radiance
from storage.digests import canonical_json, sha256_hex
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest

_CURVES = {"log": log10_radiance, "linear": clamped_radiance, "object": log10_radiance}


def load_or_render_reference(
    child: IsolatedChild, scene: Scene, camera: PixelCamera, spp: int
) -> RawReference:
    """Return two halves of raw samples of a view, from the cache or rendered by a child.

    Args:
        spp: samples per pixel of both halves together, a multiple of 128.
    """
    view = [camera.c2w.tolist(), camera.fov_deg, camera.resolution, spp]
    name = sha256_hex(canonical_json([scene_digest(scene), *view]))
    path = cache_folder("raw-references") / f"{name}.safetensors"
    if not path.is_file():
        made = child.call(raw_reference, scene, camera, spp)
        halves = {"a": made.a_rgb.astype(np.float32), "b": made.b_rgb.astype(np.float32)}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, save(halves))
    stored = load(path.read_bytes())
    return RawReference(a_rgb=stored["a"].astype(np.float64), b_rgb=stored["b"].astype(np.float64))


def figures(view: RenderedView, reference: RawReference) -> dict[str, float]:
    """Return stated and true errors of a picture in dB, with the reference's uncertainty."""
    mean = 0.5 * (reference.a_rgb + reference.b_rgb)
    stated_db = {
        "log": view.noise_floor_db,
        "linear": view.noise_floor_linear_db,
        "object": view.object_noise_floor_db,
    }
    values = {
        "spp": float(view.spp),
        "at_cap": float(view.at_cap),
        "brightness": 100 * float(view.radiance_rgb.mean() / mean.mean() - 1),
    }
    for name, curve in _CURVES.items():
        pixels = view.hits if name == "object" else np.ones_like(view.hits)
        true_db, open_db = true_error_db(view.radiance_rgb, reference, curve, pixels)
        excess_db = stated_db[name] - true_db
        values |= {
            f"{name}_stated_db": stated_db[name],
            f"{name}_true_db": true_db,
            f"{name}_open_db": open_db,
            f"{name}_caution_db": -excess_db,
            f"{name}_over_1": float(excess_db > 1),
            f"{name}_over_3": float(excess_db > 3),
        }
    return values


def difference_db(ours: RawReference, theirs: RawReference, curve: Curve) -> float:
    """Return the difference of two renderers in dB, without the noise of both.

    The squared difference is the mean of (A - C) (B - D), with halves A and B of one and C and D of
    the other. It may be below 0 by chance, which counts as no difference.
    """
    means = (0.5 * (one.a_rgb + one.b_rgb) for one in (ours, theirs))
    weight = np.square(secant_slope(curve, *means))
    product = (ours.a_rgb - theirs.a_rgb) * (ours.b_rgb - theirs.b_rgb)
    return float(-10 * np.log10(max((weight * product).mean(), LEAST_ERROR)))


def shrink_reference(reference: RawReference, resolution: int) -> RawReference:
    """Return a reference of a smaller width, which divides the reference's."""
    halves = np.stack([reference.a_rgb, reference.b_rgb])
    size = halves.shape[1] // resolution
    blocks = halves.reshape(2, resolution, size, resolution, size, 3).mean(axis=(2, 4))
    return RawReference(a_rgb=blocks[0], b_rgb=blocks[1])
