"""Pictures of a texture as albedos and roughness: linear means, and no more light than comes in."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.objects.maps.texture_set import texture_set
from storage.conventions import linear_from_srgb8


def _flat(value: float, channels: int = 1) -> NDArray[np.float32]:
    return np.full((4, 4, channels), value, np.float32)


def test_a_base_colour_alone_is_a_dielectric() -> None:
    made = texture_set({"base": _flat(128 / 255, 3)}, 8)
    linear = linear_from_srgb8()[128]
    specular = 0.04 + 0.96 / 21
    np.testing.assert_allclose(made.specular_rgb, specular, rtol=1e-6)  # float32
    np.testing.assert_allclose(made.diffuse_rgb, linear * (1 - specular), rtol=1e-6)
    assert made.roughness is None


def test_a_metal_has_its_colour_in_the_lobe() -> None:
    made = texture_set({"base": _flat(1.0, 3), "metallic": _flat(1.0)}, 8)
    assert made.diffuse_rgb.max() == 0
    np.testing.assert_allclose(made.specular_rgb, 1.0, rtol=1e-6)


def test_a_specular_map_gives_way_where_both_are_over_one() -> None:
    made = texture_set({"base": _flat(1.0, 3), "specular": _flat(0.5)}, 8)
    assert made.diffuse_rgb.min() == 1 and made.specular_rgb.max() == 0
    assert made.specular_rgb.shape == (4, 4, 3)


def test_means_are_of_linear_values_and_of_widths() -> None:
    """Black and white squares are half as bright together, which encoded ones are not."""
    squares: NDArray[np.float32] = np.zeros((8, 8, 1), np.float32)
    squares[::2, 1::2] = squares[1::2, ::2] = 1
    made = texture_set({"base": squares, "specular": _flat(0.0), "roughness": squares}, 2)
    assert made.roughness is not None
    np.testing.assert_allclose(made.diffuse_rgb, 0.5, rtol=1e-6)
    np.testing.assert_allclose(made.roughness, np.sqrt(0.5), rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "fitted"), [((8, 4), (4, 2)), ((3, 9), (1, 4)), ((2, 2), (2, 2))]
)
def test_proportions_stay_and_parts_of_other_sizes_fit(
    shape: tuple[int, int], fitted: tuple[int, int]
) -> None:
    base = np.full((*shape, 3), 1, np.float32)
    made = texture_set({"base": base, "roughness": _flat(0.3)}, 4)
    assert made.diffuse_rgb.shape[:2] == fitted
    assert made.roughness is not None and made.roughness.shape == (*fitted, 1)


def test_the_content_is_the_base_colour() -> None:
    base = _flat(0.5, 3)
    alone, rough = texture_set({"base": base}, 8), texture_set({"base": base, "roughness": base}, 2)
    assert alone.content_sha256 == rough.content_sha256
    assert texture_set({"base": base * 0.9}, 8).content_sha256 != alone.content_sha256
