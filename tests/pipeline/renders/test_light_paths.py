"""Light tracing beside the path tracer: each alone and both together show the same light."""

import dataclasses

import numpy as np
import pytest

from pipeline.renders import vector_tracer
from pipeline.renders.load_tracer import load_tracer
from pipeline.renders.renderer import set_threads
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene
from tests.pipeline.renders.path_strategies import CameraPathsLeft, CameraPathsOnly, LightPathsOnly
from tests.pipeline.renders.sampling import Estimate, assert_agree, camera_of, render_blocks
from tests.pipeline.renders.scene_kit import box, join, light, material, quad, sphere

pytestmark = pytest.mark.usefixtures("llvm")

LAMP = [[0.8, 0.3, 1.6], [1.1, 0.3, 1.6], [0.9, 0.6, 1.7]]


def _ball(roughness: float, *, lamp_diffuse: float = 0.0, closed: bool = False) -> Scene:
    """A coarse ball with smooth normals throws light on a floor that is a little glossy."""
    floor = material(diffuse=[0.6, 0.5, 0.4], specular=0.2, roughness=0.5)
    metal = material(diffuse=0.05, specular=[0.9, 0.8, 0.7], roughness=roughness)
    parts = [
        quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], floor),
        sphere([0, 0, 0.5], 0.4, metal, rings=5),
        light(LAMP, 40.0, lamp_diffuse),
        light(np.array(LAMP) - [1.5, 0, 0.8], [1.0, 2.0, 4.0], lamp_diffuse),
    ]
    if closed:
        walls = material(diffuse=0.5, specular=0.2, roughness=0.3)
        parts.append(box([0, 0, 1], 5.0, walls, kind="shell"))
    return join(parts, eye=(0, -2.2, 1.2), target=(0, 0, 0.3), fov_deg=45)


def _matt() -> Scene:
    grey = material(diffuse=[0.7, 0.5, 0.3])
    floor, wall = (
        quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], grey),
        quad([[-2, 1, 0], [2, 1, 0], [2, 1, 2], [-2, 1, 2]], grey),
    )
    return join([floor, wall, light(LAMP, 40.0)], eye=(0, -2.2, 1.2), fov_deg=60)


def _leaning() -> Scene:
    """A large light shines on a wall that a wrong shading normal turns upwards by 30 degrees."""
    floor = quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.6))
    corners = [[-2, 1, 0], [2, 1, 0], [2, 1, 2], [-2, 1, 2]]
    wall = quad(corners, material(specular=0.9, roughness=0.8))
    turned = np.broadcast_to([0, -np.sqrt(0.75), 0.5], wall.normals.shape)
    wall = dataclasses.replace(wall, normals=turned)
    lamp = light([[-1, -1, 1.5], [1, -1, 1.5], [0, -1, 2.5]], 5.0, 0.5)
    return join([floor, wall, lamp], eye=(0, -0.2, 2), target=(0, 0.3, 0), fov_deg=40)


@pytest.mark.slow("statistics")
@pytest.mark.parametrize(
    ("scene", "max_depth"),
    [(_matt(), 10), (_leaning(), 3), (_ball(0.6), 3),
     (_ball(0.6, lamp_diffuse=1.0, closed=True), 10)],
    ids=["matt", "leaning", "glossy", "closed, white emitters"],
)  # fmt: skip
def test_light_paths_alone_carry_all_indirect_light(scene: Scene, max_depth: int) -> None:
    """The two integrators share no estimate of it: one starts at the camera, one at the lights."""
    indirect = _less(
        _means(CameraPathsOnly, scene, max_depth=max_depth),
        _means(CameraPathsOnly, scene, max_depth=2, first_seed=100),
    )
    landed = _means(LightPathsOnly, scene, max_depth=max_depth, first_seed=200)
    # Where a smooth normal leans away from the light (measured: 0.2 % of the light of the coarse
    # ball), a path can be drawn from the camera only; light paths leave that out.
    assert_agree(landed, indirect, slack=5e-3)
    assert indirect.mean.min() > 10 * indirect.error.max()


@pytest.mark.parametrize(
    ("scene", "max_depth"),
    [(_ball(0.3), 10),
     pytest.param(_ball(0.3, lamp_diffuse=1.0), 2, marks=pytest.mark.slow("statistics")),
     (_ball(0.3, lamp_diffuse=0.5, closed=True), 3)],
    ids=["glossy", "white emitters", "closed"],
)  # fmt: skip
def test_together_they_show_what_the_path_tracer_shows(scene: Scene, max_depth: int) -> None:
    """Weights sum to 1 for every path, whatever it is made of."""
    alone = render_blocks(scene, tracer=CameraPathsOnly(scene, max_depth=max_depth, rr_depth=2))
    tracer = load_tracer(scene, max_depth=max_depth, rr_depth=2)
    together = render_blocks(scene, first_seed=500, tracer=tracer)
    assert_agree(together, alone)
    lit = alone.mean > 0.01 * alone.mean.max()
    score = (together.mean - alone.mean)[lit] / np.hypot(alone.error, together.error)[lit]
    # As in test_twin_tracers: errors of 16 passes each; caustics have a tail.
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.3
    assert len(score) > 90 and abs(score.mean()) < 0.5


def test_any_number_of_light_paths_gives_the_same_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """However the weights are shared out."""
    scene = _leaning()
    alone = _means(CameraPathsOnly, scene, passes=12)
    for light_paths in (1e-3, 4.0):
        monkeypatch.setattr(vector_tracer, "LIGHT_PATHS", light_paths)
        assert_agree(_means(VectorTracer, scene, first_seed=300, passes=12), alone)


def test_beside_light_paths_without_number_only_direct_light_is_left() -> None:
    """Of a large light, so that as much would be hit as picked."""
    row = material(diffuse=0.3, specular=0.5, roughness=0.4)
    floor, wall = (
        quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], row),
        quad([[-2, 1, 0], [2, 1, 0], [2, 1, 2], [-2, 1, 2]], row),
    )
    lamp = light([[-1, -1, 1.5], [1, -1, 1.5], [0, -1, 2.5]], 5.0, 0.5)
    scene = join([floor, wall, lamp], eye=(0, -0.2, 2), target=(0, 0.3, 0), fov_deg=40)
    left = _means(CameraPathsLeft, scene, first_seed=100, passes=12)
    # Weights leave a millionth, but more where a vertex is close to the next one, in the corner.
    assert_agree(left, _means(CameraPathsOnly, scene, max_depth=2, passes=12), slack=1e-3)


def test_light_paths_do_not_show_emitters_either() -> None:
    """A white panel above a lit floor fills the picture, and stays hidden from the camera."""
    floor = quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.6))
    panel = light([[-2.0, 1.0, 0.5], [2.0, 1.0, 0.5], [0.0, 1.0, 4.0]], 1.0, 1.0)
    parts = [floor, panel, light(LAMP, 40.0)]
    scene = join(parts, eye=(0, -2, 1), target=(0, 1, 1.5), fov_deg=20)
    tracer = LightPathsOnly(scene, max_depth=10, rr_depth=9)
    np.testing.assert_array_equal(tracer.radiance(camera_of(scene, 32), seed=1, spp=64), 0)


def test_a_caustic_has_a_fraction_of_the_noise() -> None:
    """What a mirror beside the picture throws on the floor; measured: 0.12 of the variance."""
    floor = quad([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], material(diffuse=0.5))
    mirror = material(specular=0.9, roughness=0.1)
    wall = quad([[-1.5, -1, 0], [-1.5, 1, 0], [-1.5, 1, 1], [-1.5, -1, 1]], mirror)
    lamp = light([[1.2, -0.1, 1.4], [1.2, 0.1, 1.4], [1.2, 0, 1.6]], 40.0)
    scene = join([floor, wall, lamp], eye=(0, -0.2, 2), target=(-0.2, 0, 0), fov_deg=40)
    camera_paths = CameraPathsOnly(scene, max_depth=3, rr_depth=2)
    alone = render_blocks(scene, tracer=camera_paths, passes=10)
    together = render_blocks(scene, max_depth=3, rr_depth=2, passes=10)
    assert np.square(together.error).mean() < 0.25 * np.square(alone.error).mean()
    assert_agree(together, alone)
    direct = render_blocks(scene, max_depth=2, rr_depth=2, passes=4)
    assert (together.mean - direct.mean).max() > 0.2 * direct.mean.max()


def test_the_same_bits_for_any_number_of_threads() -> None:
    scene = _ball(0.1, lamp_diffuse=0.5, closed=True)
    tracer = load_tracer(scene, max_depth=10, rr_depth=2)
    pictures = []
    for threads in (1, 2, 3):
        set_threads(threads)
        pictures.append(tracer.radiance(camera_of(scene, 32), seed=3, spp=16))
    set_threads(2)
    assert pictures[0].max() > 0
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])


def _means(
    kind: type[VectorTracer],
    scene: Scene,
    *,
    max_depth: int = 10,
    first_seed: int = 0,
    passes: int = 32,
) -> Estimate:
    """Return the mean of the picture from some passes."""
    tracer = kind(scene, max_depth=max_depth, rr_depth=2)
    return render_blocks(scene, block=32, passes=passes, first_seed=first_seed, tracer=tracer)


def _less(a: Estimate, b: Estimate) -> Estimate:
    return Estimate(mean=a.mean - b.mean, error=np.hypot(a.error, b.error))
