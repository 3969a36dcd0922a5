"""Makes the raw pictures that z-tests compare with.

    python -m tests.pipeline.renders.stored_pictures

Each is the mean of many independent passes, with the variance of one pass at every pixel. Make them
anew only when the light itself is meant to change, and say so in docs/results/studies.md.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.tracer import Tracer
from storage.records.scene import Scene
from storage.seeds import seed_for
from tests.pipeline.renders.scene_kit import Part, box, join, light, material, quad, sphere

FOLDER = Path(__file__).parents[2] / "references" / "raw"
RESOLUTION = 48
PASS_SPP = 64
_STORED_PASSES = 512

_FLOOR = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
_BACK = [[-1, 1, 0], [1, 1, 0], [1, 1, 2], [-1, 1, 2]]
_LEFT = [[-1, -1, 0], [-1, 1, 0], [-1, 1, 2], [-1, -1, 2]]
_SMALL_LAMP = [[-0.3, -0.3, 1.9], [0.3, -0.2, 1.9], [0, 0.3, 1.8]]
_SIDE_LAMP = [[0.9, -0.5, 0.4], [0.9, 0.1, 0.4], [0.9, -0.2, 1.0]]


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredPicture:
    """What is known of the right picture."""

    mean_rgb: NDArray[np.float64]
    """[R, R, 3] mean of all passes."""
    pass_variance: NDArray[np.float64]
    """[R, R, 3] variance of one pass of PASS_SPP samples."""
    num_passes: int
    """Passes that the mean is of."""


def scenes() -> dict[str, Scene]:
    """Return the scenes by name: diffuse, glossy with smooth normals, and two unequal lamps."""
    red = material(diffuse=[0.7, 0.1, 0.1])
    grey, glossy = material(diffuse=0.6), material(diffuse=0.2, specular=0.6, roughness=0.4)
    metal = material(specular=[0.9, 0.7, 0.4], roughness=0.6)
    ball, block = sphere([-0.3, 0.2, 0.45], 0.4, glossy), box([0.4, -0.1, 0.3], 0.5, metal, 0.4)
    room = [quad(_FLOOR, grey), quad(_BACK, grey), quad(_LEFT, red)]
    lamp = light(_SMALL_LAMP, [30, 28, 25])
    both = [lamp, light(_SIDE_LAMP, [2, 4, 9])]
    return {
        "diffuse": _scene([*room, box([0.3, 0, 0.3], 0.5, red, 0.3), lamp]),
        "glossy": _scene([*room, ball, block, lamp]),
        "two-lamps": _scene([quad(_FLOOR, glossy), quad(_BACK, grey), ball, *both]),
    }


def _scene(parts: list[Part]) -> Scene:
    return join(parts, eye=(1.2, -3.2, 1.6), target=(0, 0, 0.5), fov_deg=40)


def passes(tracer: Tracer, scene: Scene, count: int, seed: int) -> NDArray[np.float64]:
    """Return `count` independent passes [count, R, R, 3] of a scene's first view."""
    camera = Camera(
        c2w=scene.c2w[0].astype(np.float64),
        fov_deg=float(scene.fov_deg[0]),
        resolution=RESOLUTION,
    )
    return np.stack(
        [
            tracer.radiance(camera, seed=seed_for(seed, "pass", index), spp=PASS_SPP)
            for index in range(count)
        ]
    ).astype(np.float64)


def load(name: str) -> StoredPicture:
    """Return the stored picture of a scene."""
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as arrays:
        return StoredPicture(
            mean_rgb=arrays["mean_rgb"].astype(np.float64),
            pass_variance=arrays["pass_variance"].astype(np.float64),
            num_passes=int(arrays["num_passes"]),
        )


def _store(name: str, scene: Scene) -> None:
    from pipeline.renders.load_tracer import load_tracer

    tracer = load_tracer(scene, max_depth=10, rr_depth=2)
    taken = passes(tracer, scene, _STORED_PASSES, seed=1_000_003)
    FOLDER.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        FOLDER / f"{name}.npz",
        mean_rgb=taken.mean(axis=0).astype(np.float32),
        pass_variance=taken.var(axis=0, ddof=1).astype(np.float32),
        num_passes=np.int64(len(taken)),
    )


if __name__ == "__main__":
    from pipeline.renders.variant import activate, choose_variant

    activate(choose_variant())
    for scene_name, made in scenes().items():
        _store(scene_name, made)
