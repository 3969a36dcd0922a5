"""Radiance pictures: what they say, and every way in which one can be wrong."""

import itertools

import numpy as np
import pytest

from pipeline.objects.maps.rgbe import rgbe_radiance
from storage.errors import Rejected
from tests.for_each import for_each
from tests.pipeline.objects.maps.map_files import hdr


def _texels(rows: int, columns: int) -> np.ndarray:
    texels = np.random.default_rng(1).integers(2, 256, (rows, columns, 4)).astype(np.uint8)
    texels[..., 3] = 120 + texels[..., 3] % 30
    texels[0, : columns // 2] = (7, 9, 11, 130)  # a run
    texels[1, 1] = (200, 100, 50, 0)  # an exponent of 0 is black
    return texels


@for_each("runs, columns", itertools.product([True, False], [8, 300]))
def test_values_are_mantissa_times_a_power_of_two(runs: bool, columns: int) -> None:
    texels = _texels(3, columns)
    found = rgbe_radiance(hdr(texels, runs=runs), 200)
    expected = texels[..., :3] / 256 * 2.0 ** (texels[..., 3:].astype(int) - 128)
    expected[texels[..., 3] == 0] = 0
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)  # powers of two: exact


def test_damaged_and_foreign_files_are_refused_with_a_reason() -> None:
    whole = hdr(_texels(4, 16), runs=True)
    cases = {
        "not_hdr": [
            b"",
            b"P6 4 4",
            hdr(_texels(2, 16), runs=True, header="EXPOSURE=2.0\n"),
            whole.replace(b"32-bit_rle_rgbe", b"32-bit_rle_xyze"),
            whole.replace(b"-Y 4", b"+Y 4"),
        ],
        "too_many_pixels": [
            whole.replace(b"-Y 4", b"-Y 99999"),
            whole.replace(b"+X 16", b"+X 99999"),
            whole.replace(b"-Y 4", b"-Y 0"),
        ],
        "load_error": [
            whole[:-5],
            whole.replace(b"-Y 4", b"-Y 40"),
            whole.replace(b"+X 16", b"+X 17"),
            whole[: whole.index(b"+X 16") + 6 + 4] + b"\xff" * 400,
            whole[: whole.index(b"+X 16") + 6 + 4] + b"\x00" * 400,
            hdr(np.full((2, 4, 4), 1, np.uint8), runs=False),
        ],
    }
    for reason, files in cases.items():
        for number, data in enumerate(files):
            with pytest.raises(Rejected) as found:
                rgbe_radiance(data, 100)
            assert found.value.reason == reason, (reason, number)
