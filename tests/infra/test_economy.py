"""What a set left out: counted from its own records, and nothing claimed that is not done."""

import dataclasses

import pytest

from infra.bench.economy import _geometry, _samples, _smallest
from infra.bench.economy_counts import SceneCosts, _costs
from storage.sample import SceneRecord, encode_sample
from tests.train.toy import RESOLUTION, toy_sample

COSTS = SceneCosts(
    triangles=100, source_faces=400, object_faces=80, spp=(32, 256), at_cap=(False, False),
    floors_db=(44.0, 40.0), array_bytes=4000, record_bytes=500, picture_bytes=9000, empty_share=0.2,
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
    found = _costs(record, sizes, {f"box/{row}": 48 for row in boxes}, RESOLUTION)
    assert found.triangles == scene.num_triangles
    assert (found.source_faces, found.object_faces) == (48 * len(boxes), 12 * len(boxes))
    assert found.array_bytes + found.record_bytes + found.picture_bytes == sum(sizes.values())
    assert found.at_cap == tuple(view.at_cap for view in sample.views)
    assert 0 <= found.empty_share < 1


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
