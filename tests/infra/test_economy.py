"""What a set left out: counted from its own records, and nothing claimed that is not done."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from infra.bench.economy import _geometry, _samples, _smallest
from infra.bench.economy_counts import SceneCosts, _costs, _error_within
from infra.bench.economy_line import base_flops
from infra.bench.economy_totals import in_all, passes
from storage.asset import Asset
from storage.errors import TrilightError
from storage.sample import SceneRecord, encode_sample
from tests.scenes.small_pool import QUALITY, small_pool, with_error
from tests.train.toy import RESOLUTION, toy_sample

COSTS = SceneCosts(
    triangles=100, source_faces=400, object_faces=80, spp=(32, 256), at_cap=(False, False),
    floors_db=(44.0, 40.0), array_bytes=4000, record_bytes=500, picture_bytes=9000, empty_share=0.2,
    object_errors=(0.01, 0.03), stored_pictures=2,
)  # fmt: skip


def test_a_scene_is_counted_from_its_sample() -> None:
    sample = toy_sample(0)
    boxes = [row for row, entry in enumerate(sample.scene.objects) if entry.kind == "object"]
    objects = tuple(
        dataclasses.replace(entry, uid=f"box/{row}") if row in boxes else entry
        for row, entry in enumerate(sample.scene.objects)
    )
    scene = dataclasses.replace(sample.scene, objects=objects)
    sample = dataclasses.replace(sample, scene=scene)
    sizes = {suffix: len(data) for suffix, data in encode_sample(sample).items()}
    record = SceneRecord(key=sample.key, scene=scene, views=sample.views)
    asset = _asset((12, 0.02), (6, 0.05), sources=48)
    found = _costs(record, sizes, {f"box/{row}": asset for row in boxes}, RESOLUTION)
    assert found.triangles == scene.num_triangles
    assert (found.source_faces, found.object_faces) == (48 * len(boxes), 12 * len(boxes))
    assert found.object_errors == (0.02,) * len(boxes)  # boxes of 12 triangles: the finer level
    assert found.stored_pictures == len(sample.views)
    assert found.array_bytes + found.record_bytes + found.picture_bytes == sum(sizes.values())
    assert found.at_cap == tuple(view.at_cap for view in sample.views)
    assert 0 <= found.empty_share < 1


def _asset(*levels: tuple[int, float], sources: int) -> Asset:
    """Levels of so many triangles and such errors, of a source of so many."""
    asset = small_pool()[0].asset
    template = asset.levels[0]
    made = [
        dataclasses.replace(
            template,
            record=dataclasses.replace(template.record, quality=with_error(QUALITY, error)),
            faces=np.zeros((faces, 3), np.uint32),
        )
        for faces, error in levels
    ]
    source = dataclasses.replace(asset.source, num_faces=sources)
    return dataclasses.replace(asset, source=source, levels=tuple(made))


def test_an_object_of_another_preparation_is_told() -> None:
    with pytest.raises(TrilightError, match="of 5 triangles is coarser than every level"):
        _error_within(_asset((6, 0.05), sources=48), 5)


SETTINGS: dict[str, dict[str, Any]] = {
    "renders": {"resolution": 256, "max_spp": 256, "aux_spp": 64, "denoiser": "high"},
    "storage": {"profile": "compact"},
}


def test_passes_are_counted_in_the_shards() -> None:
    line = passes([COSTS], SETTINGS["renders"])
    assert line.factor == 6 and line.kept.startswith("1; rendered: colour; albedo and normal")
    with_lights = dataclasses.replace(COSTS, stored_pictures=4)
    assert passes([with_lights], SETTINGS["renders"]).factor == 3
    assert passes([COSTS], {**SETTINGS["renders"], "denoiser": "off"}).kept == "1; rendered: colour"


def test_all_together_with_the_error_that_it_adds() -> None:
    samples, network, stored = in_all([COSTS], SETTINGS, published_bytes=300_000)
    assert samples.factor == 256 / 144
    # two views of 256 x 256; a tenth more of the mean square is 0.41 dB
    assert (samples.everything, samples.kept) == ("33.6 M", "18.9 M")
    assert "median 42.0 dB as rendered, 41.6 or more as stored" in samples.error
    exact = in_all([COSTS], {**SETTINGS, "storage": {"profile": "lossless"}}, published_bytes=1)
    assert "42.0 dB as rendered, 42.0 or more as stored" in exact[0].error
    # 100 - 80 + 400 triangles with the sources in place of the objects
    assert network.factor == base_flops(420, 2, 256) / base_flops(100, 2, 256)
    assert "median 2.00 %" in network.error and "largest 3.00 %" in network.error
    # sixteen channels of half floats for each pixel of two views
    raw = 2 * 256 * 256 * 16 * 2
    assert stored.factor == pytest.approx((300_000 + raw) / 13_500)


def test_a_view_that_reached_its_target_with_its_last_samples_is_not_at_the_cap() -> None:
    line = _samples([COSTS], 256)
    assert line.factor == 256 / 144
    assert "144; 0 % of the views" in line.kept
    capped = dataclasses.replace(COSTS, at_cap=(False, True))
    assert "144; 50 % of the views" in _samples([capped], 256).kept


def test_what_is_not_left_out_by_default_saves_nothing() -> None:
    triangles, flops, bundles = _geometry([COSTS], 256)
    assert triangles.factor == 5.0
    assert flops.factor > 1  # padded to 1572 triangles
    assert bundles.factor == 1.0 and "20 %" in bundles.kept


def test_the_smallest_scene_is_told_beside_the_largest() -> None:
    large = dataclasses.replace(COSTS, triangles=1536, array_bytes=40_000)
    flops, arrays = _smallest([large, COSTS], 256)
    assert "100 triangles" in flops.part and "for 1536 triangles" in flops.everything
    assert arrays.factor == pytest.approx(10)
