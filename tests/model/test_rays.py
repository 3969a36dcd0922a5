"""Laws of rays: they are those of storage.conventions, and bundling loses nothing."""

import numpy as np
import torch

from model.rays import bundle_rays, ray_directions, unbundle
from storage.conventions import camera_rays
from storage.seeds import rng_for
from tests.for_each import for_each


@for_each("resolution", [8, 24, 256])
@for_each("fov_deg", [1.0, 30.0, 45.0, 60.0, 170.0])
def test_rays_agree_with_the_conventions(resolution: int, fov_deg: float) -> None:
    _, expected = camera_rays(np.eye(4), fov_deg, resolution)
    fov = torch.tensor(fov_deg, dtype=torch.float64)
    got = ray_directions(fov, resolution).movedim(0, -1).numpy()
    # the same formula in float64 on both sides
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14)
    rounded = ray_directions(fov.float(), resolution).movedim(0, -1).numpy()
    # float32 tangent and square root: a millionth of a radian is a thousandth of a pixel at most
    np.testing.assert_allclose(rounded, expected, rtol=0, atol=1e-6)


def test_a_bundle_holds_its_patch_channel_major() -> None:
    resolution, patch = 24, 8
    picture = torch.arange(3 * resolution**2).reshape(1, 3, resolution, resolution)
    bundles = bundle_rays(picture, patch)
    assert bundles.shape == (1, 9, 192)
    for row in range(3):
        for column in range(3):
            rows, columns = slice(8 * row, 8 * row + 8), slice(8 * column, 8 * column + 8)
            assert torch.equal(bundles[0, 3 * row + column], picture[0, :, rows, columns].flatten())


def test_unbundling_inverts_bundling() -> None:
    rng = rng_for(0, "picture")
    picture = torch.from_numpy(rng.normal(size=(2, 3, 32, 32)))
    assert torch.equal(unbundle(bundle_rays(picture, 8), 8), picture)
