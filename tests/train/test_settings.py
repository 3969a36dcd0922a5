"""Named runs exist, and contradictions are refused by field."""

import dataclasses
import json

import pytest

from model.base_widths import BaseWidths
from model.config import SIZES, large
from storage.errors import TrilightError
from storage.settings.described import settings_record
from tests.for_each import for_each
from tests.train.kit import tiny_run
from train.runs import RUNS, changed_run, in_proportion, named_run


@for_each("name", sorted(RUNS))
def test_named_runs_carry_their_name_and_survive_json(name: str) -> None:
    settings = named_run(name)
    assert settings.run == name
    record = settings_record(settings)
    assert json.loads(json.dumps(record)) == record
    assert record["model"]["width"] == settings.model.width


def test_an_unknown_run_is_refused_with_the_known_ones() -> None:
    message = "'smoek': no such run; did you mean smoke.* builtin, fine"
    with pytest.raises(TrilightError, match=message):
        named_run("smoek")


@for_each("name", sorted(RUNS))
def test_fewer_steps_bring_their_warm_up_and_intervals_along(name: str) -> None:
    """So that any number of steps is a run that is logged, judged and saved as the whole one is."""
    run = named_run(name)
    for steps in (1, 2, 7, 24, 331, run.num_steps // 2):
        shorter = changed_run(name, {}, steps=steps)
        assert shorter.num_steps == steps
        share = steps / run.num_steps
        # rounded to a whole number of rows, and never to none
        assert abs(shorter.warmup_steps - run.warmup_steps * share) <= 0.5
        assert abs(shorter.log_every - run.log_every * share) < 1
        for field in ("validate_every", "checkpoint_every"):
            assert abs(getattr(shorter, field) - getattr(run, field) * share) <= shorter.log_every
        assert shorter.keep_every % shorter.checkpoint_every == 0
        assert (shorter.keep_every > 0) == (run.keep_every > 0)
    assert changed_run(name, {}, steps=run.num_steps) == run
    longer = changed_run(name, {}, steps=3 * run.num_steps)
    assert dataclasses.replace(longer, num_steps=run.num_steps) == run


def test_what_is_stated_is_not_brought_along() -> None:
    stated = {"warmup_steps": 5, "validate_every": 12, "checkpoint_every": 24}
    found = changed_run("smoke", stated, steps=24)
    assert {name: getattr(found, name) for name in stated} == stated
    assert changed_run("smoke", {"checkpoint_every": 9}, steps=80).log_every in (1, 3)
    assert not in_proportion(named_run("smoke"), 24, stated).keys() & stated.keys()
    with pytest.raises(TrilightError, match="warmup_steps is 50; expected 0 to 23"):
        changed_run("smoke", {"warmup_steps": 50}, steps=24)
    with pytest.raises(TrilightError, match="num_steps'? is 0; expected a whole number from 1"):
        changed_run("smoke", {}, steps=0)
    for value, message in ((0, "is 0; expected a whole number from 1"), ("often", "is 'often'")):
        with pytest.raises(TrilightError, match=f"log_every'? {message}"):
            changed_run("pretrain", {"log_every": value}, steps=24)


@for_each(
    ("changes", "message"),
    [
        ({"resolution": 20}, "resolution is 20; expected a multiple of 8"),
        ({"warmup_steps": 12}, "warmup_steps is 12; expected 0 to 11"),
        ({"validate_every": 5}, "validate_every is 5; expected a multiple of log_every, 2"),
        ({"checkpoint_every": 3}, "checkpoint_every is 3"),
        ({"precision": "float16"}, "precision is 'float16'; expected float32 or bfloat16"),
    ],
)
def test_contradictory_settings_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        tiny_run(**changes)


def test_the_paper_runs_are_the_papers() -> None:
    """Zeng et al. 2025, section 4, and the published configuration."""
    first, second = named_run("paper-pretrain"), named_run("paper-finetune")
    assert (first.resolution, first.most_triangles, first.num_steps) == (256, 1536, 500_000)
    assert (first.scenes_per_step, first.views_per_scene) == (128, 2)
    assert (first.warmup_steps, first.learning_rate) == (8_000, 1e-4)
    assert (second.resolution, second.most_triangles, second.num_steps) == (512, 4096, 100_000)
    for run in (first, second):
        assert (run.loss.perceptual, run.loss.perceptual_weight) == ("lpips", 0.05)
        assert (run.betas, run.weight_decay, run.grad_clip) == ((0.9, 0.999), 0.01, 1.0)
        assert (run.augmentation.rotation, run.augmentation.translation) == ("recipe", 0.25)
        assert run.ema_decay == run.muon_rate == 0 and not run.augmentation.mirror
        assert run.base_widths == BaseWidths() and run.base_widths.width == 0
    assert second.from_weights and not first.from_weights


def test_the_large_runs_are_the_published_large_recipe() -> None:
    """Of its training code: rates, warm-up and steps; 4 and 6 scenes on each of 8 cards."""
    first, second = named_run("paper-pretrain-large"), named_run("paper-finetune-large")
    for run, base in ((first, "paper-pretrain"), (second, "paper-finetune")):
        small = named_run(base)
        assert run.model == large()
        for name in ("loss", "augmentation", "resolution", "most_triangles", "views_per_scene"):
            assert getattr(run, name) == getattr(small, name), name
        for name in ("betas", "weight_decay", "grad_clip", "final_rate_share", "precision"):
            assert getattr(run, name) == getattr(small, name), name
    assert (first.num_steps, first.warmup_steps, first.learning_rate) == (600_000, 8_000, 1e-4)
    assert (second.num_steps, second.warmup_steps, second.learning_rate) == (50_000, 4_000, 5e-5)
    assert (first.scenes_per_step, second.scenes_per_step) == (4 * 8, 6 * 8)
    assert second.recompute_activations and not first.recompute_activations
    assert second.from_weights and not first.from_weights


def test_every_size_can_be_asked_for_by_name() -> None:
    for name, make in SIZES.items():
        assert changed_run("smoke", {"model": name}).model == make()
    without = changed_run("pretrain", {"model.window_bundles": 0, "model": "large"})
    assert without.model == dataclasses.replace(large(), window_bundles=0)
    with pytest.raises(TrilightError, match="'model' is 'larg'; did you mean large"):
        changed_run("smoke", {"model": "larg"})
    with pytest.raises(TrilightError, match="resolution is 72; expected a multiple of 64"):
        changed_run("smoke", {"model": "large", "resolution": 72})
