"""What a set left out: counted from its own records, and nothing claimed that is not done."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from infra.bench.experiments.economy import (
    ALL_FLOPS,
    FLOPS,
    LEAST_FLOPS,
    LEAST_KB,
    OBJECTS,
    SAMPLES,
    SceneCosts,
    _costs,
    _error_within,
    _errors,
    _geometry,
)
from infra.bench.sides.networks import base_flops
from storage.errors import TrilightError
from storage.records.asset import Asset
from storage.records.sample import SceneRecord, encode_sample
from tests.pipeline.scenes.small_pool import QUALITY, small_pool, with_error
from tests.train.toy import toy_sample

COSTS = SceneCosts(
    triangles=100, source_faces=400, object_faces=80, spp=(32, 256), at_cap=(False, False),
    floors_db=(44.0, 40.0), array_bytes=4000, record_bytes=500, picture_bytes=9000,
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
    found = _costs(record, sizes, {f"box/{row}": asset for row in boxes})
    assert found.triangles == scene.num_triangles
    assert (found.source_faces, found.object_faces) == (48 * len(boxes), 12 * len(boxes))
    assert found.object_errors == (0.02,) * len(boxes)  # boxes of 12 triangles: the finer level
    assert found.stored_pictures == len(sample.views)
    assert found.array_bytes + found.record_bytes + found.picture_bytes == sum(sizes.values())
    assert found.at_cap == tuple(view.at_cap for view in sample.views)


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


def test_parts_are_counted_with_everything_and_as_kept() -> None:
    large = dataclasses.replace(COSTS, triangles=1536, array_bytes=40_000)
    found = _geometry([COSTS, large], SETTINGS)
    assert found[OBJECTS] == (400, 80)
    assert found[SAMPLES] == (256, 144)
    assert found[LEAST_KB] == (40, 4)
    assert found[LEAST_FLOPS] == tuple(base_flops(n, 2, 256) / 1e9 for n in (1536, 100))
    assert found[FLOPS][0] == base_flops(1572, 2, 256) / 1e9 > found[FLOPS][1]
    # 100 - 80 + 400 and 1536 - 80 + 400 triangles with the sources in place of the objects
    sources = (base_flops(420, 2, 256) + base_flops(1856, 2, 256)) / 2e9
    assert found[ALL_FLOPS] == (pytest.approx(sources), found[FLOPS][1])


def test_what_is_left_out_is_told_with_its_error() -> None:
    words = "; ".join(_errors([COSTS], SETTINGS))
    # a tenth more of the mean square is 0.41 dB
    assert "median 42.0 dB as rendered, 41.6 or more as stored" in words
    assert "median 2.00 %" in words and "largest 3.00 %" in words
    assert words.startswith("0 % of the views end at the cap")
    exact = "; ".join(_errors([COSTS], {**SETTINGS, "storage": {"profile": "lossless"}}))
    assert "42.0 dB as rendered, 42.0 or more as stored" in exact
