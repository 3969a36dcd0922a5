"""`trilight bench trade` as a whole on tiny pictures: children, references, a checkpoint, files."""

import json
from contextlib import closing
from pathlib import Path

import pytest
import torch

from infra.bench import harness
from infra.bench.harness import Options
from infra.bench.renders import kept
from infra.bench.trade import run
from infra.bench.trade.curves import judged
from infra.bench.trade.knobs import knob_named
from infra.bench.trade.saved import saved_curves
from infra.bench.trade.workshop import Workshop
from model.config import smoke
from model.layer_errors import random_network
from model.weights import encode_weights
from pipeline.objects.generated import generate_objects
from pipeline.objects.licences import DEFAULT_ALLOWED
from tests.command_line import trilight
from tests.infra.trade_kit import TINY

pytestmark = pytest.mark.slow

WITH_CHILDREN = (
    "samples", "budget", "profile", "scene-budget", "detail", "views", "bundles", "pipeline",
)  # fmt: skip


def test_knobs_with_children_of_their_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(run, "QUICK", TINY)
    monkeypatch.setattr(harness, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(kept, "cache_folder", lambda name: tmp_path / name)
    checkpoint = tmp_path / "model.safetensors"
    torch.manual_seed(0)
    checkpoint.write_bytes(encode_weights(random_network(smoke())))
    words = [word for name in (*WITH_CHILDREN, "engines") for word in ("--knob", name)]
    result = trilight(["bench", "trade", "--quick", "--checkpoint", str(checkpoint), *words])
    assert result.exit_code == 0, result.exception
    (path,) = (tmp_path / "results").glob("trade-*.json")
    assert path.with_suffix(".png").stat().st_size > 10_000
    assert set(json.loads(path.read_bytes())["curves"]) == {*WITH_CHILDREN, "engines"}
    for name, saved in saved_curves(tmp_path / "results").items():
        assert any(one.on_front for one in judged(knob_named(name), saved.curve))
    budget = saved_curves(tmp_path / "results")["budget"].curve
    pictures = [point.further["picture, psnr_log_db"] for point in budget.points]
    assert pictures[-1] > pictures[0]  # 1024 triangles look more like the source than 64
    engines = saved_curves(tmp_path / "results")["engines"].curve
    assert len({point.error for point in engines.points}) == 1  # equal error on all sides
    assert len(engines.details) == TINY.scenes
    # a network of random weights is no match for a single denoised sample
    assert {row["denoised bound"] for row in engines.details} == {"at most"}
    for point in engines.points[1:]:
        assert point.further["scenes where no samples suffice %"] == 0
    assert "`builtin:benchmark-v1`" in engines.measured_on


def test_objects_of_a_folder(tmp_path: Path) -> None:
    """They have names of their own, and are made coarser like any other."""
    folder = tmp_path / "mine"
    folder.mkdir()
    for index, record in enumerate(generate_objects("builtin:24", tmp_path / "made")):
        (folder / f"thing-{index}.ply").write_bytes(Path(record.path).read_bytes())
    options = Options(quick=True, objects=(str(folder),), allowed_licences=DEFAULT_ALLOWED)
    with closing(Workshop(TINY, options)) as shop:
        assert all(path.parent == folder for path in shop.sources)
        assert 0 < len(shop.sources) <= TINY.objects
        curve = knob_named("profile").measure(shop)
    assert [point.default for point in curve.points].count(True) == 1
