"""`--like` and `--settings`: settings of another dataset or run, and of a file to share."""

import json
from pathlib import Path
from typing import Any

import pytest

from infra.cli.changes import Shared, all_changes
from infra.cli.dataset_changes import with_shared
from infra.cli.settings_file import read_settings_file
from pipeline.builds.named import BUILDS, named_build
from pipeline.making.dataset_order import DatasetOrder
from storage.dataset.manifest import read_manifest
from storage.errors import TrilightError
from storage.settings.changes import changed
from storage.settings.described import settings_record
from tests.command_line import trilight
from tests.for_each import case
from tests.pipeline.making.test_publication import begin_tiny
from train.runs import RUNS, named_run

FAR = "out-of-range"


def _file(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


def test_a_build_like_another_is_that_other() -> None:
    for build in BUILDS:
        with case(build):
            other = named_build(build)
            changes = all_changes(named_build("smoke"), Shared(), other.as_json(), {})
            assert changed(named_build("smoke"), changes).as_json() == other.as_json()
            assert all_changes(other, Shared(), other.as_json(), {}) == {}


def test_a_run_like_another_is_that_other() -> None:
    for run in RUNS:
        with case(run):
            other = named_run(run)
            changes = all_changes(named_run("smoke"), Shared(), settings_record(other), {})
            assert changed(named_run("smoke"), changes) == other


def test_a_dataset_is_followed_and_options_count_more(tmp_path: Path) -> None:
    publication = begin_tiny(tmp_path / "set", 12)
    record = read_manifest(publication.folder.manifest).settings
    shared = Shared(
        like=str(tmp_path / "set"),
        settings=_file(tmp_path, "renders: {resolution: 96, max_spp: 64}\nseed: 1\n"),
    )
    alike = with_shared(DatasetOrder(build=FAR), Shared(like=shared.like))
    found = named_build(FAR, changes=alike.changes).as_json()
    assert found == {**record, "build": FAR}
    order = DatasetOrder(build=FAR, resolution=32, changes={"renders.max_spp": 128})
    changes = with_shared(order, shared).changes
    settings = named_build(FAR, changes=changes)
    assert (settings.seed, settings.renders.resolution, settings.renders.max_spp) == (1, 32, 128)
    assert settings.scenes.num_views == record["scenes"]["num_views"]


def test_a_floor_that_is_asked_for_replaces_those_of_a_file(tmp_path: Path) -> None:
    file = _file(tmp_path, "renders: {noise_floor_db: 44, noise_floor_objects_db: 43}\n")
    order = with_shared(DatasetOrder(noise_floor_linear_db=36.0), Shared(settings=file))
    assert named_build("smoke", changes=order.changes).renders.targets_db == {
        "psnr_linear_db": 36.0
    }
    as_filed = with_shared(DatasetOrder(), Shared(settings=file)).changes
    assert named_build("smoke", changes=as_filed).renders.targets_db == {
        "psnr_log_db": 44.0,
        "object_psnr_log_db": 43.0,
    }


def test_a_preset_takes_the_place_of_single_settings(tmp_path: Path) -> None:
    file = _file(tmp_path, "model: {width: 60}\nloss.perceptual: none\n")
    changes = all_changes(named_run("smoke"), Shared(settings=file), {}, {"model": "tiny"})
    assert changes == {"loss.perceptual": "none", "model": "tiny"}


def test_a_file_says_what_set_would() -> None:
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


WRONG: dict[str, tuple[str, str]] = {
    "seed: 1\nseed: 2\n": ("line 2", "seed is given twice"),
    "renders:\n  max_spp: 64\nrenders.max_spp: 64\n": ("line 3", "renders.max_spp is given twice"),
    "- seed\n": ("line 1", "expected names with values"),
    "seed: {\n": ("line 2", "expected"),
    "? [a]\n: 1\n": ("line 1", "expected the name of a setting"),
    "a: [{b: 1, b: 2}]\n": ("line 1", "a name is given twice"),
    "seed: 1\nrenders:\n  resolution: wide\n": ("line 3", "'renders.resolution' is 'wide'"),
    "seeed: 1\n": ("line 1", "did you mean seed?"),
}


def test_what_is_wrong_in_a_file_is_named_with_its_line(tmp_path: Path) -> None:
    for command in ["generate", "plan"]:
        for text in WRONG:
            with case((command, text)):
                file = _file(tmp_path, text)
                told = trilight([command, "smoke", "--settings", file]).mistake
                line, problem = WRONG[text]
                assert told.startswith(f"{file}, {line}: ")
                assert problem in told


ABSENT = [
    (["--settings", "none.yaml"], "--settings none.yaml: not readable"),
    (["--like", "nowhere"], "--like nowhere: nowhere/settings.json cannot be read"),
]


def test_what_is_not_there_is_named() -> None:
    for words, problem in ABSENT:
        with case(words):
            assert trilight(["train", "smoke", *words]).mistake.startswith(problem)


def test_a_run_is_followed_on_the_command_line(tmp_path: Path) -> None:
    """As far as the data, which are not there: the settings were checked before."""
    record: dict[str, Any] = settings_record(named_run("smoke")) | {"num_steps": 7}
    (tmp_path / "settings.json").write_text(json.dumps({"settings": record}))
    words = ["train", "smoke", "--like", str(tmp_path), "--data", str(tmp_path / "no")]
    with pytest.raises(TrilightError, match="warmup_steps is 50"):
        changed(named_run("smoke"), {"num_steps": 7})
    assert "warmup_steps is 50" in trilight(words).mistake
    ended = trilight([*words, "--set", "warmup_steps=2"])
    assert "Run smoke: 7 steps" in ended.stdout


def test_licences_are_allowed_beside_those_of_a_file(tmp_path: Path) -> None:
    order = DatasetOrder(allow_licences=("CC-BY-NC-4.0",))
    for text, others in (
        ("seed: 1\n", named_build("smoke").allowed_licences),
        ("allowed_licences: [MIT]\n", ("MIT",)),
    ):
        found = with_shared(order, Shared(settings=_file(tmp_path, text)))
        settings = named_build("smoke", allow_licences=found.allow_licences, changes=found.changes)
        assert settings.allowed_licences == tuple(sorted({*others, "CC-BY-NC-4.0"}))


def test_an_order_without_shared_settings_stays_as_it_is_and_is_checked() -> None:
    order = DatasetOrder(resolution=64, seed=3, changes={"renders.max_spp": 128})
    assert with_shared(order, Shared()) == order
    ended = trilight(["generate", "smoke", "--resolution", "20"])
    assert "resolution is 20; expected a multiple of 8" in ended.mistake
    assert ended.stdout == "", "before any work is announced"
