"""The sides of the network's experiments are one network; memory, scenes and steps are counted."""

from infra.bench.sides.networks import (
    CPU,
    DEFAULT,
    EQUAL,
    PUBLISHED,
    SIDES,
    Contenders,
    log10_psnr_db,
    published_like,
    scene_of,
    timed_forward,
)
from model.costs import Workload
from model.published.config import PublishedConfig
from tests.for_each import case
from tests.model.published.test_convert import publishable

CONFIG = PublishedConfig(model=publishable("dpt"), texture_patch=8)
FULL = Workload(triangles=300, views=2, resolution=32)


def test_the_sides_are_one_network() -> None:
    contenders = Contenders(CONFIG, SIDES, CPU)
    found = {side: timed_forward(contenders.prepared(side, FULL), CPU)[0] for side in SIDES}
    # float32 rounds sums of size 1 to 1e-7, over a dozen layers
    assert (published_like(found[EQUAL]) - found[PUBLISHED]).abs().max() < 1e-5
    # bfloat16 keeps 8 bits: a network of this depth is off by a percent, a wrong one by all
    assert 30 < log10_psnr_db(found[DEFAULT], found[EQUAL]) < 99
    first, second = found[EQUAL]
    assert (first - second).abs().max() > 0.01  # one view is not the other


def test_scenes_have_the_size_that_is_asked_for() -> None:
    for triangles in [16, 140, 301]:
        with case(triangles):
            scene = scene_of(Workload(triangles=triangles, views=3, resolution=32))
            assert scene.num_triangles == triangles and scene.num_views == 3
            assert scene.material_TM[:, -3:].max() > 0, "a light is among them"
            assert len(scene.c2w_V44.unique(dim=0)) == 3
