"""Every way on of docs/how-to/carry-on-a-run.md, tried: what stopped a run, and what goes on.

And what a run is, and what a command that resumes it may say: named runs exist, and contradictions
are refused by field. Execution is as one likes, meaning as it was, or a decision.
"""

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pydantic
import pytest
import torch
from torch import Tensor

from model.config import SIZES
from model.open import open_network, path_of_step, saved_steps
from storage.dataset.dataset import Dataset, open_dataset
from storage.digests import canonical_json, sha256_hex
from storage.errors import LAST_COMMIT, TrilightError
from storage.settings.described import settings_record
from tests.for_each import for_each
from tests.train.data.test_mixture import BAD_KEY, spoil_sample
from tests.train.kit import TINY_MODEL, Heard, Killed, apart, tiny_run, trained
from tests.train.toy import write_toy_dataset
from train import run_training as run_module
from train.data.buckets import TrainingBatch
from train.folder import RunFolder
from train.loop import step as step_module
from train.loop.checkpoints import read_checkpoint
from train.loop.recorder import read_rows
from train.loop.step import PendingStats, Stepper
from train.presets import (
    TRAINING_PRESETS,
    override_training_preset,
    scale_intervals,
    training_preset,
)
from train.resume import StartPlan, plan_resume
from train.settings import AugmentationSettings, TrainSettings, known_settings, stored_settings


def wsd(**changes: Any) -> TrainSettings:
    """Return a run with a constant rate, and none of the things that only take time here."""
    few = {
        "schedule": "wsd",
        "ema_decay": 0.9,
        "num_steps": 5,
        "warmup_steps": 1,
        "log_every": 1,
        "validate_every": 1000,
        "checkpoint_every": 4,
        "validation_scenes": 1,
    }
    return tiny_run(**(few | changes))


def weights(place: Path) -> dict[str, Tensor]:
    return open_network(place).state_dict()


SHORT = wsd(checkpoints_kept=1, checkpoint_every=3)


@pytest.fixture(scope="module")
def short(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of five steps whose rate falls after the fourth; to be copied."""
    return trained(SHORT, dataset, tmp_path_factory.mktemp("short")).folder


def test_an_extended_run_is_a_longer_one_to_the_bit(
    dataset: Dataset, short: RunFolder, tmp_path: Path
) -> None:
    """From where the short one's decay begins, which is kept for it; and the short one is whole."""
    long = trained(wsd(num_steps=10), dataset, tmp_path / "long")
    assert saved_steps(short.checkpoints) == [4, 5]
    begins = path_of_step(short.checkpoints, 4)
    whole = read_checkpoint(path_of_step(long.folder.checkpoints, 8)).arrays
    start: dict[str, Any] = {"branch": str(begins), "decisions": {"num_steps": 10}}
    extended = trained(SHORT, dataset, tmp_path / "extended", **start)
    ours = read_checkpoint(path_of_step(extended.folder.checkpoints, 8)).arrays
    assert ours.keys() == whole.keys()
    assert all((ours[name] == whole[name]).all() for name in whole), "weights, mean and memories"
    # it decays where the longer one does, so the rest is the same too
    assert extended.folder.weights.read_bytes() == long.folder.weights.read_bytes()
    assert short.weights.read_bytes() != long.folder.weights.read_bytes()
    logs = [read_rows(each.folder.metrics) for each in (extended, long)]
    losses = [[(row["step"], row.get("loss")) for row in rows if "loss" in row] for rows in logs]
    assert losses[0] == losses[1], "the branch has the log of the run that it left"
    assert [(event.kind, event.name) for event in extended.history] == [
        ("meaning", "num_steps"),
        ("origin", "checkpoint"),
    ]
    assert extended.history[1].after == {
        "run": "tiny",
        "step": 4,
        "sha256": read_checkpoint(begins).header["sha256"],
    }


def test_a_finished_run_made_longer_in_its_own_folder(
    dataset: Dataset, short: RunFolder, tmp_path: Path
) -> None:
    """Its rate rises again, which is said; the decision is on disk, in the summary, and stays."""
    shutil.copytree(short.root, tmp_path, dirs_exist_ok=True)
    with pytest.raises(TrilightError, match="num_steps is 7, but the checkpoint was made with 5"):
        trained(dataclasses.replace(SHORT, num_steps=7), dataset, tmp_path, resume=True)
    notes = Heard()
    longer = trained(
        SHORT, dataset, tmp_path, resume=True, decisions={"num_steps": 7}, progress=notes
    )
    assert longer.num_steps == 7
    assert any("the rate had been falling since step 4" in text for text in notes.notes)
    recorded = {"step": 5, "kind": "meaning", "name": "num_steps", "before": 5, "after": 7}
    record = json.loads(longer.folder.settings.read_text())
    assert record["settings"]["num_steps"] == 7 and record["history"] == [recorded]
    assert json.loads(longer.folder.summary.read_text())["history"] == [recorded]
    again = trained(SHORT, dataset, tmp_path, resume=True)
    assert again.num_steps == 7, "the command that began it goes on with what was decided"


def test_a_kill_forgets_no_decision(dataset: Dataset, short: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(short.root, tmp_path, dirs_exist_ok=True)
    path_of_step(tmp_path / "checkpoints", 5).unlink()
    with pytest.raises(Killed):
        decided = {"decisions": {"seed": 5}, "progress": Heard(killed_at=5)}
        trained(SHORT, dataset, tmp_path, resume=True, **decided)
    again = trained(SHORT, dataset, tmp_path, resume=True)
    assert [(event.step, event.name, event.after) for event in again.history] == [(4, "seed", 5)]


def test_too_little_memory_goes_on_with_fewer_scenes_a_pass(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = wsd(num_steps=6, scenes_per_step=4, checkpoint_every=2, checkpoints_kept=9)
    trained(settings, dataset, tmp_path / "whole")
    original, steps = step_module.predict_log10, [0]

    def small_card(net: Any, batch: TrainingBatch, *rest: Any) -> Tensor:
        steps[0] += 1
        if steps[0] > 6 and len(batch.target_BVRR3) > 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return original(net, batch, *rest)

    monkeypatch.setattr(step_module, "predict_log10", small_card)
    with pytest.raises(TrilightError, match=r"too little memory in step \d+.*scenes_per_pass=2"):
        trained(settings, dataset, tmp_path / "small")
    notes, step = Heard(), saved_steps(tmp_path / "small/checkpoints")[-1]
    one = dataclasses.replace(settings, scenes_per_pass=1)
    trained(one, dataset, tmp_path / "small", resume=True, progress=notes)
    assert any("scenes_per_pass is 1 instead of 16" in text for text in notes.notes)
    found, wanted = weights(tmp_path / "small"), weights(tmp_path / "whole")
    before = read_checkpoint(path_of_step(tmp_path / "small/checkpoints", step)).network()
    way = apart(wanted, before.state_dict())
    # float32 sums in another order: measured 9e-7 of the way since then
    assert 0 < apart(found, wanted) < 1e-5 * way


def test_a_bad_sample_is_left_out_by_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Met in the middle of a run: the median picture would have met it before the first step."""
    monkeypatch.setattr(run_module, "MEDIAN_SCENES", 1)
    data = write_toy_dataset(tmp_path / "data", train=8, validation=1, per_shard=2, resolution=8)
    spoil_sample(data)
    data = open_dataset(str(data.folder.root))
    each = {
        "resolution": 8,
        "num_steps": 8,
        "scenes_per_step": 1,
        "checkpoint_every": 1,
        "log_every": 1,
    }
    with pytest.raises(TrilightError, match=rf"sample {BAD_KEY}: .*OpenEXR.* --skip-unusable"):
        trained(wsd(**each), data, tmp_path / "out")
    stopped_at = saved_steps(tmp_path / "out/checkpoints")[-1]
    assert 0 < stopped_at < 8
    notes = Heard()
    allowed = wsd(**each, most_unusable=1)
    result = trained(allowed, data, tmp_path / "out", resume=True, progress=notes)
    assert sum(text.startswith("left out: ") and BAD_KEY in text for text in notes.notes) == 1
    assert BAD_KEY in result.unusable[0] and result.num_steps == 8
    assert BAD_KEY in result.folder.summary.read_text()
    (event,) = result.history
    assert (event.step, event.name, event.after) == (stopped_at, "most_unusable", 1)


def test_ten_skipped_steps_go_on_by_a_decision(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the folder, or, where the weights themselves are lost, from an earlier checkpoint.

    Resumed as it is, it ends at the same step again: the row of skipped steps is remembered.
    """
    settings = wsd(num_steps=16, keep_every=2, checkpoint_every=2)

    original = Stepper.launch

    def diverging(self: Stepper, *given: Any, **rest: Any) -> PendingStats:
        now = self._settings
        if self._state.step >= 4 and (now.learning_rate, now.seed) == (2e-3, 0):
            return torch.tensor([math.nan, math.nan, 0.0, 0.0, math.nan, 0.0, 0.0]).double()
        return original(self, *given, **rest)

    monkeypatch.setattr(Stepper, "launch", diverging)
    ways = r"10 steps in a row up to step 14.*--change learning_rate=0\.001.*seed=1.*--branch"
    for again in (False, True):
        with pytest.raises(TrilightError, match=ways):
            trained(settings, dataset, tmp_path / "run", resume=again)
    slower = {"learning_rate": 1e-3}
    in_place = trained(settings, dataset, tmp_path / "run", resume=True, decisions=slower)
    assert in_place.num_steps == 16
    early = str(path_of_step(tmp_path / "run/checkpoints", 2))
    rewound = trained(settings, dataset, tmp_path / "branch", branch=early, decisions={"seed": 1})
    assert rewound.skipped_steps == 0
    assert [event.step for event in rewound.history] == [2, 2]


def test_a_branch_takes_other_data_and_other_pictures(dataset: Dataset, tmp_path: Path) -> None:
    """With the optimiser's memories, at the steps of the run; a running mean may begin, too."""
    trained(wsd(ema_decay=0.0), dataset, tmp_path / "first")
    other = write_toy_dataset(tmp_path / "data", train=5, validation=1, per_shard=3)
    digest = f"sha256:{other.digest[:12]}"
    stage = {"data": digest, "resolution": 32, "num_steps": 6, "ema_decay": 0.5}
    branch = str(tmp_path / "first")
    with pytest.raises(TrilightError, match=f"--change data={digest}"):
        trained(wsd(ema_decay=0.0), other, tmp_path / "second", branch=branch)
    assert not (tmp_path / "second").exists()
    out = tmp_path / "second"
    start: dict[str, Any] = {"branch": branch, "decisions": stage}
    result = trained(wsd(ema_decay=0.0), other, out, **start)
    assert result.num_steps == 6
    assert {event.name for event in result.history} == {*stage, "checkpoint"}
    assert open_network(out).config == wsd().model
    with pytest.raises(TrilightError, match="holds a run already; add --resume"):
        trained(wsd(ema_decay=0.0), other, out, **start)
    again = trained(wsd(ema_decay=0.0), other, out, resume=True, **start)
    assert again.history == result.history, "the same command with --resume, as it is printed"


def test_what_is_decided_is_done(dataset: Dataset, tmp_path: Path) -> None:
    """By the stream, the loss, the update: none of them still reads what the command states."""
    settings = wsd(ema_decay=0.0)
    trained(settings, dataset, tmp_path / "whole")
    branch = str(path_of_step(tmp_path / "whole/checkpoints", 4))
    for name, value in {
        "seed": 3,
        "views_per_scene": 1,
        "augmentation.rotation": "uniform",
        "loss.perceptual": "ms_ssim",
        "weight_decay": 1.0,
        "learning_rate": 1e-3,
    }.items():
        out = tmp_path / name
        trained(settings, dataset, out, branch=branch, decisions={name: value})
        assert apart(weights(out), weights(tmp_path / "whole")) > 0, name
    trained(settings, dataset, tmp_path / "as it was", branch=branch)
    same, whole = weights(tmp_path / "as it was"), weights(tmp_path / "whole")
    assert all(torch.equal(same[name], whole[name]) for name in whole)


@for_each(
    ("start", "message"),
    [
        ({"decisions": {"seed": 1}}, "has not begun, so --change seed changes nothing"),
        ({"branch": "a", "begin_with": "b"}, "branch is a and begin_with is b; expected one"),
        ({"branch": "nowhere.safetensors"}, "checkpoint nowhere.safetensors is not readable"),
    ],
)
def test_a_start_that_is_none_is_refused(
    dataset: Dataset, tmp_path: Path, start: dict[str, Any], message: str
) -> None:
    with pytest.raises(TrilightError, match=message):
        trained(wsd(), dataset, tmp_path / "out", **start)


DIGEST = "d" * 64
OTHER = "0123456789" * 6 + "abcd"


def header(settings: TrainSettings | None = None, *, step: int = 8, **more: Any) -> dict[str, Any]:
    record = {
        "step": step,
        "settings": settings_record(settings or tiny_run()),
        "data_digest": DIGEST,
        "history": [],
    }
    return json.loads(json.dumps(record | more))


def following(before: dict[str, Any], going: StartPlan, step: int) -> dict[str, Any]:
    """Return the header of a later checkpoint of a run that went on."""
    history = [dataclasses.asdict(event) for event in going.history]
    later = header(going.settings, step=step, history=history)
    return later | {"data_digest": before["data_digest"]}


def test_the_same_command_goes_on_and_nothing_happens() -> None:
    going = plan_resume(header(), tiny_run(), DIGEST, {})
    assert going == StartPlan(settings=tiny_run(), history=(), notes=(), changes_meaning=False)


def test_removed_settings_stand_in_checkpoints_where_they_stood_or_are_refused() -> None:
    """At the values that meant none, so that checkpoints keep their bytes; others were used."""
    stored = stored_settings(tiny_run())
    assert list(stored["loss"]) == [
        "perceptual", "perceptual_weight", "lpips_precision", "noise_half"
    ]  # fmt: skip
    fields = list(stored["model"])
    assert fields[fields.index("rope_max_freq") + 1] == "projected_freqs"
    assert fields[-3:] == ["texture_cells", "sky_cells", "sky_rays"]
    known = known_settings(stored, "resume")
    later = {"denoise_from_px": 0}
    assert known | {"model": known["model"] | later} == settings_record(tiny_run())
    going = plan_resume(header() | {"settings": stored}, tiny_run(), DIGEST, {})
    assert going.settings == tiny_run() and not going.history
    for name, value in (("model.sky_cells", 48), ("loss.lpips_precision", "float16")):
        group, _, of_group = name.partition(".")
        begun = header()
        begun["settings"][group][of_group] = value
        message = f"^checkpoint: {name} is {value!r}: removed since, and commit {LAST_COMMIT} is"
        with pytest.raises(TrilightError, match=message):
            plan_resume(begun, tiny_run(), DIGEST, {})


EXECUTED: dict[str, Any] = {
    "scenes_per_pass": 1,
    "precision": "bfloat16",
    "recompute_activations": True,
    "most_unusable": 3,
    "log_every": 1,
    "validate_every": 3,
    "checkpoint_every": 5,
    "checkpoints_kept": 7,
    "keep_every": 10,
    "validation_scenes": 1,
}


def test_execution_is_free_and_noted() -> None:
    """All of it at once, since intervals have to fit each other, and back again."""
    typed = tiny_run(**EXECUTED)
    going = plan_resume(header(), typed, DIGEST, {})
    assert going.settings == typed and not going.changes_meaning
    assert {event.name for event in going.history} == set(EXECUTED)
    assert {event.kind for event in going.history} == {"execution"}
    assert "from step 8 on, scenes_per_pass is 1 instead of 16" in going.notes
    back = plan_resume(following(header(), going, 9), tiny_run(), DIGEST, {})
    assert back.settings == tiny_run() and len(back.history) == 2 * len(EXECUTED)


@for_each(
    ("changes", "message"),
    [
        (
            {"seed": 1},
            r"seed is 1, but the checkpoint was made with 0\. Go on as it was with --set seed=0, "
            "or decide on --change seed=1, which the run records",
        ),
        ({"num_steps": 20}, "num_steps is 20, but .* 12.* --set num_steps=12.*change num_steps=20"),
        ({"betas": (0.9, 0.95)}, r"--set betas=\[0.9,0.99\].* --change betas=\[0.9,0.95\]"),
        (
            {"augmentation": AugmentationSettings(mirror=True)},
            "augmentation.channels is false, .* with true, and augmentation.vertex_order is "
            "false.*--change augmentation.channels=false --change augmentation.vertex_order=false",
        ),
        (
            {"model": dataclasses.replace(TINY_MODEL, hidden_width=64)},
            "model.hidden_width is 64, but the checkpoint was made with 48.* another run in",
        ),
    ],
)
def test_other_meaning_is_refused_with_both_values_and_both_ways(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(TrilightError, match=message):
        plan_resume(header(), tiny_run(**changes), DIGEST, {})


def test_a_decision_holds_from_its_step_and_is_not_typed_again() -> None:
    first = plan_resume(
        header(), tiny_run(), DIGEST, {"learning_rate": 1e-3, "loss.noise_half": 0.5}
    )
    assert first.changes_meaning
    assert (first.settings.learning_rate, first.settings.loss.noise_half) == (1e-3, 0.5)
    (event, _) = sorted(first.history, key=lambda event: event.name)
    assert dataclasses.asdict(event) == {
        "step": 8, "kind": "meaning", "name": "learning_rate", "before": 2e-3, "after": 1e-3,
    }  # fmt: skip
    assert "from step 8 on, learning_rate is 0.001 instead of 0.002" in first.notes
    later = following(header(), first, 10)
    for typed in (tiny_run(), first.settings):  # as it was begun, or as it is
        again = plan_resume(later, typed, DIGEST, {})
        assert again.settings == first.settings and again.history == first.history
        assert not again.changes_meaning
        assert "as decided at step 8, learning_rate is 0.001" in again.notes
    same = plan_resume(later, tiny_run(), DIGEST, {"learning_rate": 1e-3})
    assert not same.changes_meaning and same.history == first.history
    with pytest.raises(TrilightError, match=r"is 0\.003, but the checkpoint was made with 0\.001"):
        plan_resume(later, tiny_run(learning_rate=3e-3), DIGEST, {})
    second = plan_resume(later, tiny_run(), DIGEST, {"learning_rate": 5e-4})
    last = plan_resume(following(later, second, 11), tiny_run(), DIGEST, {})
    assert last.settings.learning_rate == 5e-4
    assert [event.step for event in last.history] == [8, 8, 10]


@for_each(
    ("decisions", "message"),
    [
        (
            {"scenes_per_pass": 2},
            "--change scenes_per_pass: it is execution.* --set scenes_per_pass",
        ),
        ({"model.hidden_width": 64}, "model.hidden_width: it is the run's for good.*--from"),
        ({"base_widths.width": 64}, "base_widths.width: it is the run's for good"),
        ({"muon_rate": 3.0}, "muon_rate=3: the checkpoint lacks the memories"),
        ({"num_steps": 7}, "num_steps=7: 8 steps are done.*--branch"),
        ({"learning_rate": 2}, "'learning_rate' is 2; expected a number above 0, up to 1"),
    ],
)
def test_what_cannot_be_decided_is_refused(decisions: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        plan_resume(header(), tiny_run(), DIGEST, decisions)


def test_other_data_is_a_decision_by_digest() -> None:
    message = "the data are sha256:012345678901, .* sha256:dddddd.* --change data=sha256:0123456789"
    with pytest.raises(TrilightError, match=f"{message}01, which"):
        plan_resume(header(), tiny_run(), OTHER, {})
    for wrong in ("sha256:99999999999", "sha256:01", "new", 12):
        with pytest.raises(TrilightError, match="--change data is .* the data are sha256:0123456"):
            plan_resume(header(), tiny_run(), OTHER, {"data": wrong})
    going = plan_resume(header(), tiny_run(), OTHER, {"data": "sha256:012345678901"})
    (event,) = going.history
    assert (event.name, event.before, event.after) == ("data", DIGEST, OTHER)
    assert going.changes_meaning
    assert "data is sha256:012345678901 instead of sha256:dddddddddddd" in going.notes[0]
    listed = plan_resume(header(), tiny_run(), f"list:{OTHER}", {"data": "list:01234567"})
    assert listed.history[0].after == f"list:{OTHER}"
    later = following(header(), going, 9) | {"data_digest": OTHER}
    assert not plan_resume(
        later, tiny_run(), OTHER, {"data": "sha256:012345678901"}
    ).changes_meaning


def test_a_run_from_before_a_setting_stays_as_it_was() -> None:
    """Even where the named run has another value by now; until that is decided on."""
    old = header()
    for later in ("schedule", "decay_share", "recompute_activations"):
        del old["settings"][later]
    del old["settings"]["model"]["window_bundles"], old["history"]
    typed = tiny_run(schedule="wsd")
    going = plan_resume(old, typed, DIGEST, {})
    assert going.settings == tiny_run() and not going.changes_meaning
    assert going.notes == (
        "schedule is cosine and not wsd, since the run is older than that setting; --change "
        "schedule=wsd changes it",
    )
    again = plan_resume(following(old, going, 9), typed, DIGEST, {})
    assert again.settings == tiny_run() and again.history == going.history
    decided = plan_resume(following(old, going, 9), typed, DIGEST, {"schedule": "wsd"})
    assert decided.settings == typed and decided.changes_meaning
    for either in ("wsd", "cosine"):
        last = plan_resume(following(old, decided, 10), tiny_run(schedule=either), DIGEST, {})
        assert last.settings == typed


def test_a_rate_that_rises_again_is_said() -> None:
    begun = tiny_run(schedule="wsd", num_steps=20)
    late = plan_resume(header(begun, step=18), begun, DIGEST, {"num_steps": 40})
    assert any("the rate had been falling since step 16" in note for note in late.notes)
    early = plan_resume(header(begun, step=16), begun, DIGEST, {"num_steps": 40})
    assert not any("falling" in note for note in early.notes)


@for_each("name", sorted(TRAINING_PRESETS))
def test_presets_survive_json_and_fewer_steps_bring_warm_up_and_intervals_along(
    name: str,
) -> None:
    """So that any number of steps is a run that is logged, judged and saved as the whole one is."""
    run = training_preset(name)
    record = settings_record(run)
    assert run.run == name and json.loads(json.dumps(record)) == record
    for steps in (1, 2, 7, 24, 331, run.num_steps // 2):
        shorter = override_training_preset(name, {}, steps=steps)
        assert shorter.num_steps == steps
        share = steps / run.num_steps
        # rounded to a whole number of rows, and never to none
        assert abs(shorter.warmup_steps - run.warmup_steps * share) <= 0.5
        assert abs(shorter.log_every - run.log_every * share) < 1
        for field in ("validate_every", "checkpoint_every"):
            assert abs(getattr(shorter, field) - getattr(run, field) * share) <= shorter.log_every
        assert shorter.keep_every % shorter.checkpoint_every == 0
        assert (shorter.keep_every > 0) == (run.keep_every > 0)
    assert override_training_preset(name, {}, steps=run.num_steps) == run
    longer = override_training_preset(name, {}, steps=3 * run.num_steps)
    assert dataclasses.replace(longer, num_steps=run.num_steps) == run


def test_what_is_stated_is_not_brought_along() -> None:
    stated = {"warmup_steps": 5, "validate_every": 12, "checkpoint_every": 24}
    found = override_training_preset("smoke", stated, steps=24)
    assert {name: getattr(found, name) for name in stated} == stated
    assert override_training_preset("smoke", {"checkpoint_every": 9}, steps=80).log_every in (1, 3)
    assert not scale_intervals(training_preset("smoke"), 24, stated).keys() & stated.keys()
    with pytest.raises(TrilightError, match="warmup_steps is 50; expected 0 to 23"):
        override_training_preset("smoke", {"warmup_steps": 50}, steps=24)
    with pytest.raises(TrilightError, match="num_steps'? is 0; expected a whole number from 1"):
        override_training_preset("smoke", {}, steps=0)
    for value, message in ((0, "is 0; expected a whole number from 1"), ("often", "is 'often'")):
        with pytest.raises(TrilightError, match=f"log_every'? {message}"):
            override_training_preset("pretrain", {"log_every": value}, steps=24)


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


def test_every_size_can_be_asked_for_by_name_and_unknown_names_are_refused() -> None:
    message = "'smoek' is unknown; did you mean smoke.* builtin, hits"
    with pytest.raises(TrilightError, match=message):
        training_preset("smoek")
    for name, make in SIZES.items():
        assert override_training_preset("smoke", {"model": name}).model == make()
    without = override_training_preset("pretrain", {"model.window_bundles": 0, "model": "large"})
    assert without.model == dataclasses.replace(SIZES["large"](), window_bundles=0)
    with pytest.raises(TrilightError, match="'model' is 'larg'; did you mean large"):
        override_training_preset("smoke", {"model": "larg"})
    with pytest.raises(TrilightError, match="resolution is 72; expected a multiple of 64"):
        override_training_preset("smoke", {"model": "large", "resolution": 72})


SHIPPED = {
    "builtin": "f414db1e0417fdce",
    "hits": "696e3232ddd7ef98",
    "hits-tokens": "a50675f786a1c963",
    "paper-pretrain": "43524f0ab6186151",  # Zeng et al. 2025, section 4
    "paper-pretrain-launcher": "76e36268a3292e19",
    "paper-finetune": "0486d05daf1eac7e",
    "paper-pretrain-large": "54b5eefedba2fa94",  # of the published training code
    "paper-finetune-large": "c54e4a456bc09c9d",
}
"""Of what a run states beside its name and the defaults. Another digest is another run, which takes
another name."""


def test_the_runs_of_the_shipped_networks_stay_what_they_are() -> None:
    stated = pydantic.TypeAdapter(TrainSettings)
    for name, digest in SHIPPED.items():
        preset = training_preset(name)
        record = stated.dump_python(preset, mode="json", exclude_defaults=True)
        del record["run"]
        assert sha256_hex(canonical_json(record))[:16] == digest, name
