"""The arithmetic of a view as kernels, beside numpy's, and how often something is read back."""

import dataclasses
from typing import Any

import drjit as dr
import numpy as np
import pytest

from pipeline.renders.device_pictures import DevicePictures
from pipeline.renders.results import RenderedView
from pipeline.renders.settings import Filtered, RenderSettings
from pipeline.renders.view_pictures import MeasuredLook
from tests.for_each import for_each
from tests.pipeline.renders.sampling import render_view
from tests.pipeline.renders.scene_kit import sampled_like_scene
from tests.pipeline.renders.test_renderer import lit_scene

pytestmark = pytest.mark.usefixtures("llvm")

SETTINGS = RenderSettings(
    resolution=32, noise_floor_db=90.0, min_spp=32, max_spp=512, min_mean_radiance=0.0
)
"""To 512 samples: 10 passes and more decide which pixels are kept, and tiles are chosen."""


@for_each(
    "changes",
    [
        {},
        {"denoiser": "off", "max_spp": 256},
        {"per_light": True, "max_spp": 256},
        {"split": True, "split_lobes": True},
        {"per_light": True, "split": True, "max_spp": 128},
    ],
)
def test_views_are_those_of_numpy_but_for_roundings(changes: dict[str, Any]) -> None:
    settings = dataclasses.replace(SETTINGS, **changes)
    numpys = render_view(lit_scene(), settings, 3)
    ours = render_view(lit_scene(), dataclasses.replace(settings, arithmetic="device"), 3)
    assert (ours.spp, ours.at_cap) == (numpys.spp, numpys.at_cap)
    np.testing.assert_array_equal(ours.hits, numpys.hits)
    # float32 roundings, and those to half floats where pictures are apart: 2^-11 of each
    tolerance = 2 * 2**-11 if changes.get("per_light") or changes.get("split") else 1e-5
    np.testing.assert_allclose(ours.radiance_rgb, numpys.radiance_rgb, rtol=tolerance, atol=1e-6)
    np.testing.assert_allclose(_floors_db(ours), _floors_db(numpys), rtol=0, atol=0.01)


def _floors_db(view: RenderedView) -> list[float]:
    of_picture = view.noise_floor_db, view.noise_floor_linear_db, view.object_noise_floor_db
    parts = (view.part_floors or {}).values()
    return [*of_picture, *(db for floor in parts for db in dataclasses.astuple(floor))]


def test_little_is_read_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Once at a look, and little; the picture once, and once what shows anything."""
    sizes, num_looks = list[int](), 0
    for way in ("__array__", "numpy"):
        read = getattr(dr.ArrayBase, way)

        def counted(array: Any, *rest: Any, _read: Any = read, **named: Any) -> Any:
            values = _read(array, *rest, **named)
            sizes.append(values.nbytes)
            return values

        monkeypatch.setattr(dr.ArrayBase, way, counted)
    look = DevicePictures.look

    def counted_look(self: DevicePictures, quality: Filtered) -> MeasuredLook:
        nonlocal num_looks
        num_looks += 1
        return look(self, quality)

    monkeypatch.setattr(DevicePictures, "look", counted_look)
    settings = dataclasses.replace(SETTINGS, resolution=64, max_spp=256, arithmetic="device")
    render_view(sampled_like_scene(np.random.default_rng(5), num_views=1), settings)
    picture_bytes = 4 * 3 * 64**2
    small = [size for size in sizes if size < picture_bytes / 4]
    assert num_looks > 2
    assert sizes.count(picture_bytes) == 1 and len(sizes) == len(small) + 1
    # the mean of the first passes, what shows anything, and each look
    assert len(small) == 2 + num_looks
