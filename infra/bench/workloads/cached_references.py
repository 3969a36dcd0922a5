"""Cache of raw references, which cost a hundred times the pictures that they judge.

The cache holds float32 numbers, and a new reference is rounded to them, too, so that a figure does
not depend on whether its reference was cached.
"""

import numpy as np
from safetensors.numpy import load, save

from infra.render.raw_references import RawReference, raw_reference
from pipeline.isolation import IsolatedChild
from pipeline.renders.camera import PixelCamera
from storage.atomic import write_atomically
from storage.cache import cache_folder
from storage.digests import canonical_json, sha256_hex
from storage.records.scene import Scene
from storage.records.scene_file import scene_digest


def kept_reference(
    child: IsolatedChild, scene: Scene, camera: PixelCamera, spp: int
) -> RawReference:
    """Return two halves of raw samples of a view, from the cache or rendered by a child.

    Args:
        child: render child.
        scene: scene that passes `Scene.check`.
        camera: camera of the view.
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
