"""`trilight train` as it is typed and stopped, and the settings that it shares with others."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

from infra.cli.console import Bars
from infra.cli.overrides import (
    BaseSettings,
    merge_overrides,
    read_settings_file,
    with_base_settings,
)
from infra.cli.train import _BarProgress, _report
from model.open import saved_steps
from pipeline.generation.generate_options import GenerateOptions
from pipeline.presets.registry import DATASET_PRESETS, preset_settings
from storage.dataset.manifest import read_manifest
from storage.errors import TrilightError
from storage.settings.described import settings_record
from storage.settings.overrides import apply_overrides
from tests.command_line import run_program, trilight
from tests.conftest import ROOT
from tests.for_each import case
from tests.pipeline.generation.test_dataset_writer import begin_tiny
from tests.train.toy import write_toy_dataset
from train.evaluation.metrics import Lead
from train.folder import RunFolder
from train.loop.interrupts import SAVED_STATUS
from train.presets import TRAINING_PRESETS, training_preset

TINY = {
    "resolution": 16,
    "model.width": 36,
    "model.hidden_width": 48,
    "model.rope_num_freqs": 1,
    "model.encoder_layers": 1,
    "model.decoder_layers": 1,
    "views_per_scene": 2,
    "log_every": 1,
}


def test_mistakes_and_the_first_words_come_before_torch(tmp_path: Path) -> None:
    """Torch takes seconds to import; here it cannot be."""
    asked = {
        "smok": ["smok"],
        "widht": ["smoke", "--set", "widht=3"],
        "finetune": ["finetune"],
        "change": ["smoke", "--change", "seed=1"],
        "resume": ["smoke", "--resume", "--change", "seed=1", "--set", "log_every=5"],
        "steps": ["smoke", "--steps", "24"],
    }
    words = [["train", *each, "--data", str(tmp_path)] for each in asked.values()]
    code = (
        "import json, sys; sys.modules['torch'] = None\n"
        "from tests.command_line import trilight\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    ended = trilight(words)\n"
        "    print(json.dumps([ended.exit_code, ended.stdout, ended.stderr]))\n"
    )
    done = run_program([sys.executable, "-c", code, json.dumps(words)], COLUMNS="200")
    ended = dict(zip(asked, map(json.loads, done.stdout.splitlines()), strict=True))
    assert {name: status for name, (status, *_) in ended.items()} == dict.fromkeys(asked, 1)
    said = {name: mistake for name, (_, _, mistake) in ended.items()}
    assert "training preset 'smok' is unknown; did you mean smoke?" in said["smok"]
    assert "setting 'widht' does not exist" in said["widht"]
    assert "expected begin_with" in said["finetune"]
    assert "it has not begun, so --change seed changes nothing" in said["change"]
    assert "Run smoke goes on. Loading torch and the checkpoint" in ended["resume"][1]
    first = ended["steps"][1]
    assert "warmup_steps=3, log_every=1, validate_every=4, checkpoint_every=4" in first
    assert "Run smoke: 24 steps of 4 scenes at 64 pixels. Loading torch" in first
    assert "train needs PyTorch, which is not installed" in said["steps"]


def test_a_run_that_is_stopped_says_what_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Typed again as printed; real processes that are stopped are those of test_processes.

    A run without end, in a folder with a blank in its name.
    """
    out = tmp_path / "my runs" / "first"
    data = write_toy_dataset(tmp_path / "the data", train=4, validation=0, resolution=16)
    command = ["train", "smoke", "--data", str(data.folder.root), "--out", str(out)]
    command += ["--device", "cpu", "--set", "checkpoint_every=50000", "--steps", "100000"]
    command += [part for name, value in TINY.items() for part in ("--set", f"{name}={value}")]
    monkeypatch.setattr(sys, "argv", ["trilight", *command, "--resume"])
    advance = _BarProgress.advance
    steps: list[int] = []

    def interrupt(progress: _BarProgress, **facts: Any) -> None:
        """Press Ctrl-C after the first step."""
        advance(progress, **facts)
        steps.append(facts["step"])
        if len(steps) == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_BarProgress, "advance", interrupt)
    ended = trilight(command, env={"COLUMNS": "200"})
    assert isinstance(ended.exception, TrilightError)
    assert ended.exception.exit_status == SAVED_STATUS
    assert "Stopping after this step" in ended.stdout
    (saved,) = saved_steps(out / "checkpoints")
    again = shlex.join(["trilight", *command, "--resume"])
    assert ended.mistake.endswith(f"stopped at step {saved}, nothing is lost. To go on: {again}")


def test_a_second_ctrl_c_ends_a_step_that_does_not(tmp_path: Path) -> None:
    """The step is a call into C that hears no signal, as a backward pass."""
    code = (
        "import ctypes, time\n"
        "from infra.cli.console import Bars\n"
        "from infra.cli.train import _BarProgress\n"
        "from train.loop.interrupts import deferred_interrupts\n"
        "c, mutex = ctypes.CDLL(None), (ctypes.c_byte * 64)()\n"
        "c.pthread_mutex_lock(mutex)\n"
        "until = (ctypes.c_long * 2)(int(time.time()) + 300, 0)\n"
        "with Bars() as bars, deferred_interrupts(_BarProgress(bars).report_interrupt):\n"
        "    print('in the step', flush=True)\n"
        "    c.pthread_mutex_timedlock(mutex, until)\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-u", "-c", code],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert started.stdout is not None
    assert started.stdout.readline() == "in the step\n"
    started.send_signal(signal.SIGINT)
    assert "Stopping after this step" in started.stdout.readline()
    time.sleep(1.1)  # closer together they are one asking
    started.send_signal(signal.SIGINT)
    _, mistake = started.communicate(timeout=120)
    assert started.returncode == 130, mistake
    assert "ended at once; --resume goes on from the last checkpoint" in mistake


def test_a_run_that_hangs_and_is_to_stop_ends_with_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    with Bars() as bars:
        _BarProgress(bars).report_hang("training: step 7 hangs")
    assert ended == [1]
    said = capsys.readouterr().err
    assert "trilight: training: step 7 hangs; --resume goes on from the last checkpoint." in said


def test_a_wait_policy_of_the_users_own_stays() -> None:
    code = (
        "import os, sys; sys.argv = ['trilight', '--help']\n"
        "from infra.cli.app import main\n"
        "try:\n    main()\nfinally:\n    print(os.environ['OMP_WAIT_POLICY'])"
    )
    for own, expected in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        unset = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
        done = run_program([sys.executable, "-c", code], env=unset | own)
        assert done.stdout.splitlines()[-1] == expected


def test_several_processes_are_launched_by_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    """As one command line; under torchrun it would be twice as many."""
    replaced = mock.Mock(side_effect=SystemExit(0))
    monkeypatch.setattr(os, "execve", replaced)
    asked = ["train", "smoke", "--processes", "2", "--set", "seed=3", "--skip-unusable", "1"]
    assert trilight([*asked, "--json"]).exit_code == 0
    assert replaced.call_count == 1
    _, words, environment = replaced.call_args.args
    assert environment["PYTHONSAFEPATH"]
    assert words[1:6] == ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m"]
    assert " ".join(words[6:]) == "trilight train smoke --skip-unusable 1 --set seed=3 --json"
    watched = ["train", "smoke", "--processes", "2", "--hang-after", "9", "--profile", "2"]
    assert trilight([*watched, "--wandb", "light"]).exit_code == 0
    _, words, environment = replaced.call_args.args
    assert environment["PYTHONSAFEPATH"]
    assert " ".join(words[6:]) == (
        "trilight train smoke --hang-after 9.0 --profile 2 --wandb light"
    )
    monkeypatch.setenv("RANK", "0")
    assert trilight(asked).mistake.startswith("--processes is 2 under torchrun")
    assert replaced.call_count == 2


def test_under_torchrun_no_thread_of_a_library_turns_an_end_into_a_failure(tmp_path: Path) -> None:
    """torchrun ends the other processes, and says that the training failed, where one aborts."""
    (tmp_path / "aborts.py").write_text("import atexit, os\natexit.register(os.abort)\n")
    extension = str(tmp_path / "aborts.py")
    words = [sys.executable, "-m", "trilight", "--extend", extension, "presets"]
    run_program(words, status=-signal.SIGABRT)
    assert "tiny" in run_program(words, RANK="1").stdout


FAR = "out-of-range"


def _file(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


def test_a_preset_like_another_is_that_other() -> None:
    builds = [(preset_settings("smoke"), preset_settings(name)) for name in DATASET_PRESETS]
    runs = [(training_preset("smoke"), training_preset(name)) for name in TRAINING_PRESETS]
    for smoke, other in [*builds, *runs]:
        with case(other):
            record = settings_record(other)
            changes = merge_overrides(smoke, BaseSettings(), record, {})
            assert settings_record(apply_overrides(smoke, changes)) == record
            assert merge_overrides(other, BaseSettings(), record, {}) == {}


def test_a_dataset_and_a_run_are_followed_and_options_count_more(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path / "set", 12)
    record = read_manifest(publication.folder.manifest).settings
    shared = BaseSettings(
        like=str(tmp_path / "set"),
        settings=_file(tmp_path, "renders: {resolution: 96, max_spp: 64}\nseed: 1\n"),
    )
    alike = with_base_settings(GenerateOptions(build=FAR), BaseSettings(like=shared.like))
    found = settings_record(preset_settings(FAR, changes=alike.changes))
    assert found == {**record, "build": FAR}
    order = GenerateOptions(build=FAR, resolution=32, changes={"renders.max_spp": 128})
    changes = with_base_settings(order, shared).changes
    settings = preset_settings(FAR, changes=changes)
    assert (settings.seed, settings.renders.resolution, settings.renders.max_spp) == (1, 32, 128)
    assert settings.scenes.num_views == record["scenes"]["num_views"]
    # a run as far as the data, which are not there: the settings were checked before
    of_run: dict[str, Any] = settings_record(training_preset("smoke")) | {"num_steps": 7}
    (tmp_path / "settings.json").write_text(json.dumps({"settings": of_run}))
    words = ["train", "smoke", "--like", str(tmp_path), "--data", str(tmp_path / "no")]
    with pytest.raises(TrilightError, match="warmup_steps is 50"):
        apply_overrides(training_preset("smoke"), {"num_steps": 7})
    assert "warmup_steps is 50" in trilight(words).mistake
    ended = trilight([*words, "--set", "warmup_steps=2"])
    assert "Run smoke: 7 steps" in ended.stdout


def test_floors_replace_those_of_a_file_and_licences_stand_beside_its_own(tmp_path: Path) -> None:
    file = _file(tmp_path, "renders: {noise_floor_db: 44, noise_floor_objects_db: 43}\n")
    order = with_base_settings(
        GenerateOptions(noise_floor_linear_db=36.0), BaseSettings(settings=file)
    )
    assert preset_settings("smoke", changes=order.changes).renders.targets_db == {
        "psnr_linear_db": 36.0
    }
    as_filed = with_base_settings(GenerateOptions(), BaseSettings(settings=file)).changes
    assert preset_settings("smoke", changes=as_filed).renders.targets_db == {
        "psnr_log_db": 44.0,
        "object_psnr_log_db": 43.0,
    }
    order = GenerateOptions(allow_licences=("CC-BY-NC-4.0",))
    for text, others in (
        ("seed: 1\n", preset_settings("smoke").allowed_licences),
        ("allowed_licences: [MIT]\n", ("MIT",)),
    ):
        found = with_base_settings(order, BaseSettings(settings=_file(tmp_path, text)))
        settings = preset_settings(
            "smoke", allow_licences=found.allow_licences, changes=found.changes
        )
        assert settings.allowed_licences == tuple(sorted({*others, "CC-BY-NC-4.0"}))


WRONG: dict[str, tuple[str, str]] = {
    "seed: 1\nseed: 2\n": ("line 2", "seed is given twice"),
    "- seed\n": ("line 1", "expected names with values"),
    "? [a]\n: 1\n": ("line 1", "expected the name of a setting"),
    "a: [{b: 1, b: 2}]\n": ("line 1", "a name is given twice"),
    "seed: 1\nrenders:\n  resolution: wide\n": ("line 3", "'renders.resolution' is 'wide'"),
    "seeed: 1\n": ("line 1", "did you mean seed?"),
    "a: &a [1, 1]\nb: [*a, *a]\n": ("line 2", "an alias; expected the value itself"),
    "seed: &a [*a]\n": ("line 1", "an alias"),
    f"seed: {'9' * 10_000}\n": ("line 1", "seed: 9999"),
}


def test_a_file_says_what_set_would_and_what_is_wrong_is_named_with_its_line(
    tmp_path: Path,
) -> None:
    """Plain words are JSON or words, and quoted ones texts: YAML's own rules read 1e-3 as one."""
    stated = read_settings_file(str(Path(__file__).parent / "shared.yaml"))
    found = {name: value for name, (value, _) in stated.items()}
    assert found == {
        "learning_rate": 1e-3,
        "loss.perceptual": "none",
        "loss.perceptual_weight": 0,
        "model": "large",
        "betas": [0.9, 0.99],
        "run": "12",
        "scenes.families": [{"weight": 2, "name": "on"}],
        "resume": False,
        "source": None,
    }
    # a preset takes the place of single settings
    base = BaseSettings(settings=_file(tmp_path, "model: {width: 60}\nloss.perceptual: none\n"))
    changes = merge_overrides(training_preset("smoke"), base, {}, {"model": "tiny"})
    assert changes == {"loss.perceptual": "none", "model": "tiny"}
    for command in ["generate", "plan"]:
        for text in WRONG:
            with case((command, text)):
                file = _file(tmp_path, text)
                told = trilight([command, "smoke", "--settings", file]).mistake
                line, problem = WRONG[text]
                assert told.startswith(f"{file}, {line}: ")
                assert problem in told
    deep = _file(tmp_path, "seed: " + "[" * 20_000)
    told = trilight(["plan", "smoke", "--settings", deep]).mistake
    assert told.startswith(f"--settings {deep}: nested too deeply")
    for value in ("9" * 10_000, "[" * 50_000, "[" * 500 + "]" * 500):
        assert "seed" in trilight(["plan", "smoke", "--set", f"seed={value}"]).mistake
    for option in ("--settings", "--like"):
        told = trilight(["train", "smoke", option, "nowhere"]).mistake
        assert told.startswith(f"{option} nowhere: ")


def test_a_finished_run_names_what_evaluates_it(capsys: pytest.CaptureFixture[str]) -> None:
    """And a median picture without error divides nothing."""
    scores = {"log_l1": 0.0, "psnr_log_db_median": 99.0, "psnr_linear_db_median": 99.0}
    for log_l1, says in ((0.0, "(-0.0123, chance 0.0020)"), (0.1, "(-12.3%, chance 2.0%)")):
        lead = Lead(log_l1=-0.0123, error=0.001)
        result: Any = SimpleNamespace(
            **{"scores": scores, "median_scores": scores | {"log_l1": log_l1}, "lead": lead},
            **{"beats_median": False, "loss_at_start": 1.0, "loss_at_end": 1.0, "num_steps": 1},
            **{"skipped_steps": 0, "unusable": (), "history": (), "seconds": 1.0},
            folder=RunFolder(Path("runs/mine")),
        )
        _report(result, ("a", "b c"))
        shown = capsys.readouterr().out
        assert says in " ".join(shown.split()), "wherever the console breaks the line"
        next_line = "Next: trilight evaluate runs/mine --data a --data 'b c' --split validation\n"
        assert next_line in shown
