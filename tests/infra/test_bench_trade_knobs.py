"""Single knobs, answered by hand: what they compare, whom they leave out, and what counts."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from infra.bench import render_child
from infra.bench.harness import Options
from infra.bench.trade import mesh_knobs, run, workshop
from infra.bench.trade.bundle_sides import bundle_figures
from infra.bench.trade.curves import judged
from infra.bench.trade.engine_scenes import build_within
from infra.bench.trade.knobs import knob_named
from infra.bench.trade.mesh_knobs import EPSILONS, SCENE_BUDGETS, Fit, scene_fits
from infra.bench.trade.workshop import Workshop
from infra.cli.bench import Measured
from model.config import smoke
from model.layer_errors import random_network
from model.open import BUILTIN
from model.weights import encode_weights
from pipeline.flows.training_builds import smoke as smoke_build
from pipeline.isolation import ChildFailed
from storage.errors import Rejected, TrilightError
from storage.splits import split_of_object
from tests.infra.trade_kit import TINY
from tests.scenes.small_pool import small_pool
from tests.scenes_by_hand import tiny_scene

OPTIONS = Options(quick=True, objects=("builtin:",), allowed_licences=("CC0-1.0",))


class _Here(Workshop):
    """A workshop whose children answer at once, and whose network takes a second a triangle."""

    def __init__(self, answers: Any) -> None:
        super().__init__(TINY, OPTIONS)
        self._answers = answers

    def call(self, function, *arguments):  # type: ignore[no-untyped-def]
        return self._answers(*arguments)

    def network_core_s(self, triangles: float) -> float:
        return triangles


def test_budgets_are_compared_on_the_scenes_that_all_of_them_hold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The ball has 1280, 320 and 80 triangles; shells have up to 512: a scene of 600 is tight."""
    monkeypatch.setattr(mesh_knobs, "assets_of", lambda split: small_pool()[:1])
    alone = scene_fits((8192,), 40)
    both = scene_fits((600, 8192), 40)
    assert 0 < len(both) < len(alone) == 40
    # what remains are the same objects within both budgets, coarser where they must be
    for tight, loose in both:
        assert tight.triangles <= 600 and len(tight.errors) == len(loose.errors)
        assert max(tight.errors) >= max(loose.errors) == 0
        assert (loose,) in alone
    assert any(max(tight.errors) > 0 for tight, _ in both)


def test_scenes_that_are_dropped_are_counted() -> None:
    fits = tuple(Fit(triangles=100 + row, errors=(0.01,)) for row in range(len(SCENE_BUDGETS)))
    curve = knob_named("scene-budget").measure(_Here(lambda budgets, count: [fits] * 3))
    assert [point.cost for point in curve.points] == [100, 101, 102, 103, 104]
    assert "3 of 10 scenes, the same in every row; 7 that" in curve.measured_on
    assert [point.setting for point in curve.points if point.default] == ["1536 triangles"]
    with pytest.raises(TrilightError, match="none of 10 scenes fits"):
        knob_named("scene-budget").measure(_Here(lambda budgets, count: []))


class _MeshChild:
    """Prepares two of four objects; one is rejected, and one crashes at a single bound."""

    def call(self, function: Any, path: Path, epsilon: float | None) -> tuple[float, float, float]:
        if path.name == "rejected":
            raise Rejected("no_level", "none")
        if path.name == "crashing" and epsilon == EPSILONS[2]:
            raise ChildFailed("killed", "by hand")
        return 100.0 * len(path.name), epsilon or 0.001, 0.1


def test_an_object_that_fails_ends_no_curve() -> None:
    shop = _Here(None)
    shop.__dict__["mesh_child"] = _MeshChild()
    shop.__dict__["sources"] = tuple(map(Path, ("a", "rejected", "crashing", "bbb")))
    knob = knob_named("epsilon")
    curve = knob.measure(shop)
    assert [point.cost for point in curve.points] == [200.0] * len(EPSILONS)
    assert curve.measured_on.startswith("2 objects")
    assert [one.point.setting for one in judged(knob, curve) if one.point.default] == ["none"]
    shop.__dict__["sources"] = (Path("rejected"),)
    with pytest.raises(TrilightError, match="none of 1 objects"):
        knob.measure(shop)


def test_the_default_budget_of_an_object_fits_into_a_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    def remeshed(shop: Workshop, sides: Mapping[str, tuple[str, int]]) -> Any:
        figures = {"error_p99": 0.01, "error_mean": 0.01, "cpu_s": 1.0}
        return {name: {**figures, "faces": budget} for name, (_, budget) in sides.items()}

    class Meshes:
        """Gives names for meshes; one object crashes."""

        def call(self, function: Any, path: Path, budgets: Any, method: str) -> list[str]:
            if path.name == "crashing":
                raise ChildFailed("killed", "by hand")
            return [path.name, *map(str, budgets)]

    def pictures(meshes: list[str], renders: Any) -> list[float]:
        first = {"a": 20.0, "b": 30.0, "c": 90.0}[meshes[0]]
        return [first + row for row in range(len(meshes))]

    monkeypatch.setattr(mesh_knobs, "_remeshed", remeshed)
    shop = _Here(pictures)
    shop.__dict__["mesh_child"] = Meshes()
    shop.__dict__["sources"] = tuple(map(Path, ("a", "crashing", "b", "c")))
    curve = knob_named("budget").measure(shop)
    (default,) = (point for point in curve.points if point.default)
    assert default.setting == "512 triangles" and default.cost == 1024 <= 1536
    # of the first three objects those two that did not fail; the fourth is not looked at
    column = [point.further["picture, psnr_log_db"] for point in curve.points]
    assert column == [25, 26, 27, 28, 29]
    assert "median of the 2 largest objects" in curve.measured_on
    assert "with other samples has 30.0 dB" in curve.measured_on
    shop.__dict__["sources"] = (Path("crashing"),)
    with pytest.raises(TrilightError, match="knob budget: none of 1 objects could be rendered"):
        knob_named("budget").measure(shop)


def test_only_large_objects_are_made_coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {Path("large"): 5000, Path("enough"): workshop.LARGE, Path("small"): 20}
    monkeypatch.setattr(workshop, "clean_sizes", lambda child, records: found)
    monkeypatch.setattr(workshop, "object_records", lambda options: [])
    shop = Workshop(TINY, OPTIONS)
    assert shop.sources == (Path("large"), Path("enough"))
    found = {Path("small"): 20}
    with pytest.raises(TrilightError, match="none of 1 usable ones has 1100 faces"):
        _ = Workshop(TINY, OPTIONS).sources


def test_licences_of_the_user_reach_the_child(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}

    def child(folder: Path, build: Any, *, objects: str, threads: int) -> Any:
        seen.update(licences=build.allowed_licences, objects=objects)

    monkeypatch.setattr(render_child, "render_child", child)
    options = dataclasses.replace(OPTIONS, objects=("folder",), allowed_licences=("CC-BY-4.0",))
    render_child.asked_child(tmp_path, smoke_build(), options)
    assert seen == {"licences": ("CC-BY-4.0",), "objects": "folder"}


def test_empty_bundles_take_turns_with_all() -> None:
    torch.manual_seed(0)
    model, order = random_network(smoke()), []
    decode = model.decode

    def counted(*arguments: Any, skip_empty_bundles: bool = False) -> Any:
        order.append(skip_empty_bundles)
        return decode(*arguments, skip_empty_bundles=skip_empty_bundles)

    model.decode = counted  # type: ignore[assignment,method-assign]
    with torch.inference_mode():
        found = bundle_figures(model, tiny_scene(), 64)
    assert order == [False, False, True, True, False]  # the first is warm-up
    assert found.whole_core_s > 0 < found.skipping_core_s
    assert 0 < found.share_empty < 1 and found.psnr_log_db < 100


def test_all_objects_of_the_scenes_of_engines_are_to_judge_by() -> None:
    for most in (None, 768, 4096):
        build = build_within(most)
        assert build.scenes.max_triangles == min(most or 1536, 1536)
        for digit in "048f":  # any geometry
            assert split_of_object(digit * 64, build.splits) == "test"


class _Enough(Exception):
    """Nothing is to be measured."""


def test_what_is_kept_is_known_by_all_that_was_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen = []

    def kept(name: str, plan: Mapping[str, Any], *, resume: bool) -> None:
        seen.append((name, json.dumps(plan, sort_keys=True)))
        raise _Enough

    monkeypatch.setattr(run, "Kept", kept)
    torch.manual_seed(0)
    network = tmp_path / "model.safetensors"
    network.write_bytes(encode_weights(random_network(smoke())))
    first = dataclasses.replace(OPTIONS, knobs=("engines",))
    variants: list[dict[str, Any]] = [
        {},
        {"quick": False},
        {"objects": ("folder",)},
        {"allowed_licences": ("CC-BY-4.0",)},
        {"checkpoint": str(network)},
    ]
    for changes in variants:
        with pytest.raises(_Enough):
            run.run(dataclasses.replace(first, **changes), lambda: None)
    assert len({plan for _, plan in seen}) == 5
    assert [name for name, _ in seen[:2]] == ["trade-engines-quick", "trade-engines"]
    missing = dataclasses.replace(first, checkpoint="nothing.safetensors")
    with pytest.raises(TrilightError, match=r"nothing\.safetensors"):
        run.run(missing, lambda: None)


def test_the_shipped_network_is_compared_without_an_option() -> None:
    assert OPTIONS.checkpoint == BUILTIN == Measured(name="trade").checkpoint
