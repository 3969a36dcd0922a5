"""What pixels see by storage.records.first_hits, beside the renderer's own answer."""

import numpy as np
import pytest

from pipeline.renders.load_tracer import load_tracer
from storage.records.first_hits import first_hits
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.renders.scene_kit import sampled_like_scene


@pytest.mark.parametrize("seed", [0, 1])
def test_the_renderer_meets_surfaces_at_the_same_pixels(seed: int) -> None:
    scene = sampled_like_scene(np.random.default_rng(seed), num_views=2)
    tracer = load_tracer(scene, max_depth=4, rr_depth=5)
    for view in range(scene.num_views):
        seen = first_hits(scene, view=view, resolution=32)
        assert 0 < seen.met.sum()
        # a ray along a rim may go either way: two builds of Embree round differently
        assert (tracer.hits(camera_of(scene, 32, view)) != seen.met).sum() <= 1
        features = tracer.features(camera_of(scene, 32, view), spp=64)
        _same_normals(seen.shading_normal, features.normal)


def _same_normals(exact: np.ndarray, averaged: np.ndarray) -> None:
    """Where a pixel's average is a unit vector, all of the pixel has one normal: that one.

    Up to its sign: the renderer turns the normals of surfaces that are seen from behind.
    """
    even = np.linalg.norm(averaged, axis=-1) > 0.9999
    even &= np.isfinite(exact[..., 0])
    assert even.sum() > 50
    cosine = abs(np.sum(exact * averaged, axis=-1))[even]
    # unit vectors whose average is as long as 0.9999 lie within 0.8 degrees of it on average;
    # the centre of a pixel may lie at the edge of that
    assert np.median(cosine) > 0.9999
    assert cosine.min() > 0.99
