"""The sides of the network's experiments are one network; memory, scenes and steps are counted."""

import json
from pathlib import Path

import pytest

from infra.bench.experiments.network_size import trained_scores
from infra.bench.sides.network_memory import peaks_of
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


@pytest.mark.slow
def test_the_published_side_pays_for_textures() -> None:
    """It needs its own input at least, of which ours is a thousandth."""
    published, equal = (peaks_of(side, CONFIG, [FULL], CPU)[0] for side in (PUBLISHED, EQUAL))
    assert published > 4 * 13 * 8 * 8 * FULL.triangles
    assert 0 < equal < published


@pytest.mark.parametrize("triangles", [16, 140, 301])
def test_scenes_have_the_size_that_is_asked_for(triangles: int) -> None:
    scene = scene_of(Workload(triangles=triangles, views=3, resolution=32))
    assert scene.num_triangles == triangles and scene.num_views == 3
    assert scene.material_TM[:, -3:].max() > 0, "a light is among them"
    assert len(scene.c2w_V44.unique(dim=0)) == 3


@pytest.mark.slow
def test_what_a_size_is_worth_is_the_mean_of_its_trainings(tmp_path: Path) -> None:
    def row(scenes: int, log_l1: float, change: str = "ours") -> str:
        scores = {"log_l1": log_l1, "psnr_log_db_median": 20.0}
        return json.dumps({"change": change, "plan": "cpu", "scenes": scenes, "size": "small",
                           "scores": scores, "num_steps": 400})  # fmt: skip

    table = tmp_path / "table.jsonl"
    rows = [row(60, 0.9), row(960, 0.25), row(960, 0.5), row(960, 0.1, "muon")]
    table.write_text("\n".join(rows) + "\n")
    found = trained_scores("table, small", table)
    assert found == {"log_l1": 0.375, "trained_db": 20.0, "steps": 400.0}
    assert trained_scores("base", table) == {}
