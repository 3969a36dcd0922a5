"""Sets of one price: recipes are builds, logs say where a set is cut, the table compares."""

import json
import math
from pathlib import Path

import pytest
from PIL import Image

from infra.bench import equal_sets, training_jobs
from infra.bench.equal_set_recipes import COMMON, JUDGE, RECIPES, USUAL, Recipe
from infra.bench.equal_sets import cut_set, report_lines
from infra.bench.training_jobs import Plan
from infra.bench.training_table import read_table
from pipeline.flows.builds import named_build
from storage.layout import DatasetFolder
from storage.scene_log import log_scene
from tests.train.kit import TINY_MODEL


def _asked(recipe: Recipe) -> dict[str, object]:
    """Return the settings that the command line is told, as it reads them."""
    words = recipe.arguments
    assert words[::2] == ["--set"] * (len(words) // 2)
    pairs = (word.split("=", 1) for word in words[1::2])
    return {name: json.loads(value) for name, value in pairs}


@pytest.mark.parametrize("name", [*RECIPES, "judge"])
def test_a_recipe_is_a_build(name: str) -> None:
    recipe = JUDGE if name == "judge" else RECIPES[name]
    usual, own = (
        named_build("smoke", changes=_asked(one)).as_json() for one in (RECIPES[USUAL], recipe)
    )
    assert own == usual if name == USUAL else own != usual
    assert own["renders"]["resolution"] == usual["renders"]["resolution"]
    assert {*recipe.changes} <= {*COMMON, "renders.min_spp", "scenes.num_views"}


def test_a_set_is_the_shards_that_its_price_pays_for(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    for shard, cores in enumerate((1, 2, 1)):
        name = f"train-{shard:06d}.tar"
        folder.shard(name).write_bytes(b"")
        for scene in range(4):
            log_scene(folder, name, scene, seconds=2.5, cores=cores, num_rejected=0)
    folder.shard("validation-000003.tar").write_bytes(b"")
    assert cut_set(folder, math.inf).core_s == 40
    for price, scenes in ((9, 0), (10, 4), (29, 4), (30, 8), (40, 12)):
        bought = cut_set(folder, price)
        assert (bought.num_scenes, len(bought.shards)) == (scenes, scenes // 4)
        assert bought.core_s <= price


def test_the_table_compares_with_the_usual_set_of_the_same_price() -> None:
    def row(recipe: str, price: float, seed: int, error: float) -> dict[str, object]:
        return {
            "recipe": recipe, "price_core_s": price, "seed": seed, "scores": {"log_l1": error},
            "num_scenes": 10, "core_s": 50.0, "seconds": 7.0,
        }  # fmt: skip

    rows = [
        row(recipe, price, seed, error + 0.01 * seed)
        for recipe, price, error in (("usual", 100, 0.095), ("clean", 100, 0.045), ("noisy", 25, 1))
        for seed in (0, 1)
    ]
    lines = report_lines(rows)[4:]
    assert lines[0].startswith("| 25 | noisy:") and "x" not in lines[0].split("|")[5]
    assert lines[1].startswith("| 100 | usual:") and "| 0.1000 (0.0050) |" in lines[1]
    assert lines[2].startswith("| 100 | clean:") and "| 0.0500 (0.0050), x0.500 |" in lines[2]
    assert "| 5.00 |" in lines[2]


@pytest.mark.slow
def test_a_set_grows_is_learned_from_and_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan(sizes={"small": TINY_MODEL}, resolution=16, num_steps=100, scenes_per_step=2)
    monkeypatch.setitem(training_jobs.PLANS, "cpu", plan)
    cheap = {"renders.resolution": 16, "renders.max_spp": 32}
    monkeypatch.setattr(equal_sets, "RECIPES", {"usual": Recipe(words="tiny", changes=cheap)})
    few = {**cheap, "splits.scenes_per_shard": 2, "splits.shards_per_cycle": 8}
    monkeypatch.setattr(equal_sets, "JUDGE", Recipe(words="tiny", changes=few))
    table = tmp_path / "table.jsonl"
    for _ in range(2):  # what is there is kept
        equal_sets.main(work=tmp_path / "work", core_seconds=60.0, table=table)
        rows = read_table(table)
        assert [(row["price_core_s"], row["seed"]) for row in rows] == [
            (15.0, 0), (15.0, 1), (60.0, 0), (60.0, 1),
        ]  # fmt: skip
    with Image.open(table.with_suffix(".png")) as picture:
        assert picture.width > picture.height > 300
    assert 0 < rows[0]["num_scenes"] < rows[2]["num_scenes"]
    assert rows[0]["core_s"] <= 15 and rows[2]["core_s"] <= 60
