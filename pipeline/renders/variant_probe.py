"""Run as a process of its own: renders a tiny picture with the variant that its argument names.

LLVM's library is the one of the environment. Ends with status 0 only when the picture is as bright
as it must be: a white light above the middle of a grey floor, seen from the side.
"""

import resource
import sys

import mitsuba
import numpy as np

from storage.conventions import look_at_c2w
from storage.scene import Scene, SceneObject


def main() -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # an abort is an answer, not an accident
    mitsuba.set_variant(sys.argv[1])
    from pipeline.renders.renderer import SceneRenderer
    from pipeline.renders.settings import RenderSettings

    settings = RenderSettings(
        resolution=8, noise_floor_db=20, min_spp=32, max_spp=32, aux_spp=16, denoiser="off"
    )
    scene = _scene()
    view = SceneRenderer(scene, settings).render_view(scene.c2w[0], 40.0, seed=0)
    if not (view.hits.all() and 0.01 < float(view.radiance_rgb.mean()) < 1):
        raise SystemExit(f"wrong picture: mean {view.radiance_rgb.mean()}")


def _scene() -> Scene:
    positions = [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0], [0, 0, 3], [1, 0, 3], [0, 1, 3]]
    materials = np.zeros((2, 10), np.float32)
    materials[0] = [0.4, 0.4, 0.4, 0.4, 0.4, 0.4, 0.5, 0, 0, 0]
    materials[1, 7:] = 10
    return Scene(
        vertex_positions=np.array(positions, np.float32),
        vertex_normals=np.tile(np.array([0, 0, 1], np.float32), (7, 1)),
        faces=np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.uint32),
        material_index=np.array([0, 0, 1], np.uint16),
        materials=materials,
        object_index=np.array([0, 0, 1], np.uint16),
        c2w=look_at_c2w(eye=[0, -3, 2], target=[0, 0, 0], up=[0, 0, 1])[None].astype(np.float32),
        fov_deg=np.array([40], np.float32),
        objects=(
            SceneObject(name="floor", kind="shell"),
            SceneObject(name="light", kind="emitter"),
        ),
        provenance={},
    )


if __name__ == "__main__":
    main()
