"""Laws of rays and positions: the conventions', rotary products that see differences only."""

import math

import numpy as np
import torch

from model.positions import (
    TriangleRotary,
    encode_normals,
    encoded_normal_width,
    rotate,
    to_camera,
)
from model.rays import bundle_rays, ray_directions, unbundle
from storage.conventions import camera_rays
from storage.seeds import rng_for
from tests.for_each import for_each
from tests.model.kit import random_scene


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


@for_each("num_freqs", [1, 2, 3, 6])
def test_products_of_rotated_vectors_depend_on_the_difference_of_positions(num_freqs: int) -> None:
    rotary = TriangleRotary(num_freqs=num_freqs, max_freq=5.0, head_width=128).double()
    generator = torch.Generator().manual_seed(0)
    q, k = torch.randn(2, 1, 1, 1, 128, generator=generator, dtype=torch.float64)
    here, there, shift = torch.randn(3, 1, 1, 3, 3, generator=generator, dtype=torch.float64)

    def product(offset: torch.Tensor) -> torch.Tensor:
        return (rotate(q, *rotary(here + offset)) * rotate(k, *rotary(there + offset))).sum()

    # float64 sums of 128 products of size 1
    torch.testing.assert_close(product(shift), product(0 * shift), rtol=0, atol=1e-12)
    assert abs(product(shift) - (q * k).sum()) > 1e-3, "positions must matter at all"


def test_angles_are_coordinate_times_frequency_coordinate_major() -> None:
    rotary = TriangleRotary(num_freqs=2, max_freq=5.0, head_width=40)
    cos, sin = rotary(torch.arange(1.0, 10.0).reshape(1, 1, 3, 3))
    expected = [1, 5, 2, 10, 3, 15, 4, 20, 5, 25, 6, 30, 7, 35, 8, 40, 9, 45, 0, 0]
    # float32 sine of angles up to 45 radians
    torch.testing.assert_close(cos[0, 0], torch.tensor(expected).cos(), rtol=0, atol=1e-5)
    torch.testing.assert_close(sin[0, 0], torch.tensor(expected).sin(), rtol=0, atol=1e-5)


@for_each(
    ("num_freqs", "max_freq", "expected"),
    [
        (1, 5.0, [1.0]),
        (3, 5.0, [1.0, 5.0**0.5, 5.0]),
        # both published sets, as the documents print them
        (6, 5.0, [1, 1.38, 1.90, 2.63, 3.62, 5.0]),
        (6, 11.0, [1, 1.62, 2.61, 4.22, 6.81, 11.0]),
    ],
)
def test_frequencies_are_log_spaced(num_freqs: int, max_freq: float, expected: list[float]) -> None:
    rotary = TriangleRotary(num_freqs=num_freqs, max_freq=max_freq, head_width=128)
    # two printed decimals
    torch.testing.assert_close(rotary.freqs_F, torch.tensor(expected), rtol=0, atol=6e-3)


def test_rotation_pairs_channel_i_with_channel_i_plus_half() -> None:
    x = torch.eye(4).reshape(1, 4, 1, 4)
    angle = torch.tensor([0.3, 0.7])
    turned = rotate(x, angle.cos().reshape(1, 1, 2), angle.sin().reshape(1, 1, 2))[0, :, 0]
    a, b = 0.3, 0.7
    expected = torch.tensor(
        [
            [math.cos(a), 0, math.sin(a), 0],
            [0, math.cos(b), 0, math.sin(b)],
            [-math.sin(a), 0, math.cos(a), 0],
            [0, -math.sin(b), 0, math.cos(b)],
        ]
    )
    torch.testing.assert_close(turned, expected)


def test_normal_encoding_of_known_numbers() -> None:
    normals = torch.linspace(-1, 1, 9, dtype=torch.float64).reshape(1, 1, 3, 3)
    encoded = encode_normals(normals, octaves=3)[0, 0]
    flat = normals.flatten()
    phases = [c * 2**k for c in flat.tolist() for k in range(3)]
    sines = [math.sin(p) for p in phases]
    cosines = [math.cos(p) for p in phases]
    expected = torch.tensor([*flat.tolist(), *sines, *cosines], dtype=torch.float64)
    assert len(encoded) == encoded_normal_width(3)
    # sin(x + pi / 2) for cos(x), in float64
    torch.testing.assert_close(encoded, expected, rtol=0, atol=1e-14)


def test_camera_space_is_the_inverse_pose() -> None:
    scene = random_scene(5, num_views=3)
    inside = to_camera(scene.triangles_T33[None], scene.c2w_V44[None])[0]
    homogeneous = torch.cat([inside, torch.ones_like(inside[..., :1])], dim=-1)
    outside = homogeneous @ scene.c2w_V44[:, None].transpose(-1, -2)
    expected = scene.triangles_T33.expand(3, -1, -1, -1)
    # float64, coordinates of size 10
    torch.testing.assert_close(outside[..., :3], expected, rtol=0, atol=1e-13)
