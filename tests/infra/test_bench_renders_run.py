"""`trilight bench render --quick` as a whole, on one or two tiny views, interrupted and resumed."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from infra.bench import harness
from infra.bench.cycles.comparison import NamedScene, sampled
from infra.bench.cycles.cycles_picture import CyclesPicture, Request
from infra.bench.renders import cost, frontier, kept, throughput
from infra.bench.renders.ladder import render_ladder
from infra.bench.renders.references import Reference
from pipeline.isolation import IsolatedChild
from storage.errors import TrilightError
from storage.scene import Scene
from tests.command_line import trilight

SCENES = [sampled(0), sampled(5)]
RESOLUTION = 16

pytestmark = pytest.mark.slow


def _reference(named: NamedScene, child: IsolatedChild) -> Reference:
    ladder = child.call(render_ladder, named.make(child), RESOLUTION, (70.0,), 1024, 3)
    view = ladder.rungs[0].view
    return Reference(
        radiance_rgb=view.radiance_rgb, noise_floor_db=view.noise_floor_db, spp=view.spp
    )


def _cycles(scene: Scene, view: int, request: Request) -> CyclesPicture:
    """A grey picture: Blender is large, and not what is tested here."""
    assert (view, request.resolution, request.spp, request.denoise) == (0, RESOLUTION, 4, True)
    grey = np.full((RESOLUTION, RESOLUTION, 3), 0.5, np.float32)
    return CyclesPicture(radiance_rgb=grey, render_s=1.0, core_s=2.0, prepare_s=3.0)


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where results go; the benchmark is tiny meanwhile."""
    names = tuple(named.name for named in SCENES)
    shots = frontier.Plan(
        scenes=names,
        resolution=RESOLUTION,
        targets_db=(30.0, 50.0),
        max_spp=256,
        mitsuba_spp=(16, 64),
        cycles_spp=(4,),
        threads=1,
    )
    views = throughput.Plan(
        scenes=names, resolutions=(16, 24), targets_db=(30.0, 50.0), max_spp=256, threads=1
    )
    for module, plan in ((frontier, shots), (throughput, views)):
        monkeypatch.setattr(module, "_chosen", lambda options: SCENES)
        monkeypatch.setattr(module, "_plan", lambda options, chosen, plan=plan: plan)
    monkeypatch.setattr(frontier, "make_reference", _reference)
    monkeypatch.setattr(frontier, "cycles_picture", _cycles)
    few = {"triangles": (100, 300), "lights": (1,), "depth": (2, 4), "resolution": (16,)}
    monkeypatch.setattr(cost, "AXES", few)
    monkeypatch.setattr(cost, "PASS_SPP", (4,))
    monkeypatch.setattr(harness, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(kept, "cache_folder", lambda name: tmp_path / name)
    yield tmp_path / "results"


def _bench(*words: str) -> None:
    result = trilight(["bench", "render", "--quick", *words])
    assert result.exit_code == 0, result.exception


def _record(results: Path, part: str) -> dict[str, Any]:
    (path,) = results.glob(f"render-{part}-quick-*.json")
    assert path.with_suffix(".png").stat().st_size > 10_000
    return dict(json.loads(path.read_text()))


def test_all_parts(results: Path) -> None:
    _bench("--price", "0.5")
    found = _record(results, "frontier")
    assert len(found["shots"]) == len(SCENES) * (2 + 2 + 1)
    assert [claim["theirs"] for claim in found["claims"]] == ["mitsuba", "mitsuba", "cycles 4"]
    cycles = [shot for shot in found["shots"] if shot["side"] == "cycles 4"]
    assert [(shot["core_s"], shot["load_s"]) for shot in cycles] == [(2.0, 3.0)] * 2
    assert all(shot["core_s"] > 0 for shot in found["shots"])
    # An easy view of 16 x 16 pixels with 128 samples, denoised, against a picture of 1024.
    ours = [shot for shot in found["shots"] if shot["side"].startswith("trilight")]
    assert min(shot["log_db"] for shot in ours) > 20
    views = _record(results, "throughput")
    assert len(views["economies"]) == 4 and len(views["views"]) == 8
    one = views["economies"][0]
    assert one["usd_for_many"] == pytest.approx(8e6 / one["views_per_core_hour"] * 0.5)
    costs = _record(results, "cost")["sides"]
    assert set(costs) == {
        "triangles 100", "triangles 300", "lights 1", "depth 2", "depth 4", "resolution 16"
    }  # fmt: skip
    assert len(list(results.iterdir())) == 6


def test_an_interrupted_part_goes_on(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(named: NamedScene, child: IsolatedChild) -> Reference:
        if named is SCENES[1]:
            raise TrilightError("the power is gone.")
        return _reference(named, child)

    monkeypatch.setattr(frontier, "make_reference", interrupted)
    result = trilight(["bench", "render", "--quick", "--part", "frontier"])
    assert isinstance(result.exception, TrilightError) and not results.exists()
    monkeypatch.setattr(frontier, "make_reference", _reference)
    _bench("--part", "frontier", "--resume")
    found = _record(results, "frontier")
    assert found["num_resumed"] == 1
    assert {shot["scene"] for shot in found["shots"]} == {named.name for named in SCENES}
    _bench("--part", "frontier", "--resume")
    assert _record(results, "frontier")["num_resumed"] == 0
