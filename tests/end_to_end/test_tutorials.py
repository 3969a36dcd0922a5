"""The tutorials of looking and comparing: every step of them, on toy scenes.

The toy sets stand where the pages before have made theirs; test_readme runs all pages from the
first on, as a reader does.
"""

import contextlib
import csv
import dataclasses
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from infra.viewer.open_source import open_handlers, page_of
from pipeline.presets.registry import preset_settings
from storage.digests import sha256_of_file
from storage.records.objects import write_objects_lock
from storage.records.scene import Scene
from storage.settings.described import settings_record
from tests.command_line import trilight
from tests.end_to_end.production_kit import Step, steps_of, tutorial
from tests.infra.viewer.served_kit import served
from tests.pipeline.documents.dataset_by_hand import edit_manifest, locked
from tests.train.toy import toy_scene, write_toy_dataset

PX = 16
"""Width of the toys' pictures, where the pages have 64."""
SMOKE = settings_record(preset_settings("smoke"))
RENDERS = SMOKE["renders"]
SMALL = ["--set", "resolution=16", "--set", "views_per_scene=2"]
"""Of trainings."""
TOYS = {
    "trilight shards select data/mine --template corner --where 'lights_per_scene >= 3'      "
    "--out data/corners": "trilight shards select data/mine --split train "
    "--template toy --out data/corners",
    "trilight assets procedural:12 --out data/watertight --budget 1188 --watertight": "trilight "
    "assets procedural:3 --out data/watertight --budget 1188 --watertight",
    "trilight generate renderformer-v1-256 --objects data/watertight --out data/v1 --scenes 128": ""
    "trilight generate renderformer-v1-256 --objects data/watertight --out data/v1 --scenes 1 "
    "--resolution 16 --noise-floor 5 --set splits.scenes_per_shard=1 --set splits.one_split=true",
}
"""What a page says of scenes that the toys have none of, or of more than a test needs."""
ASKED = {"dataset.html": "rows", "scene.html": "scene", "folder.html": "folder"}

pytestmark = [pytest.mark.slow("commands"), pytest.mark.timeout(900)]


def toy_room(index: int) -> Scene:
    """Return a toy scene whose objects say what they are."""
    scene = toy_scene(index)
    named = (
        dataclasses.replace(each, uid=f"{index}") if each.kind == "object" else each
        for each in scene.objects
    )
    return dataclasses.replace(scene, objects=tuple(named))


def toys(root: Path, *, train: int, validation: int, **settings: Any) -> None:
    """Write toy scenes as a whole dataset; `settings` are those that its manifest tells."""
    dataset = write_toy_dataset(
        root, train=train, validation=validation, resolution=PX, scene_of=toy_room
    )
    splits = ["train"] * train + ["validation"] * validation
    objects = [locked(f"{row}", split=split) for row, split in enumerate(splits)]
    write_objects_lock(dataset.folder.objects_lock, objects)
    digest = sha256_of_file(dataset.folder.objects_lock)
    told = {**settings, "renders": {**RENDERS, "resolution": PX}}
    edit_manifest(dataset, objects_lock_sha256=digest, settings=told)
    dataset.folder.card.write_text("# Toys\n")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a reader's folder, with what the pages before have made; it is the working one."""
    desk = tmp_path_factory.mktemp("desk")
    toys(desk / "data" / "mine", train=3, validation=1, **SMOKE)
    with contextlib.chdir(desk):
        began = "train smoke --data data/mine --out runs/mine --steps 2".split()
        assert trilight([*began, *SMALL]).exit_code == 0
        yield desk


def do(step: Step) -> None:
    """Do what a page says."""
    if step.language == "python":
        text = step.text.replace("resolution=64", f"resolution={PX}")
        exec(compile(text, "a tutorial", "exec"), {})
        return
    words = shlex.split(TOYS.get(step.text, step.text))
    if words[:2] == ["trilight", "view"]:
        look(words[2])
    else:
        assert words[0] == "trilight", step.text
        run(words[1:])


def run(words: list[str]) -> None:
    """Run a command in this process; a training is a short one."""
    if words[0] == "train":
        words = [re.sub(r"^(num_steps=)?(\d)0$", r"\1\2", word) for word in words] + SMALL
    ended = trilight(words)
    assert ended.exit_code == 0, (words, ended.output)


def look(source: str) -> None:
    """Ask what a page asks first."""
    page = page_of(source)
    with served(open_handlers(source, checkpoint=None, threads=1), page) as asker:
        status, told, _ = asker.ask(f"api/{ASKED[page]}")
        assert status == 200 and told, source


@pytest.mark.parametrize(
    ("page", "made"),
    [
        (
            "look-around",
            ["data/corners/report.html", "data/files/more/room.usdz", "data/mine/templates.png"],
        ),
        ("stand-on-a-leaderboard", ["boards/mine/leaderboard.png", "data/for-others/views.csv"]),
        ("../how-to/coming-from-scripts", ["data/v1-energon/.nv-meta/split.yaml"]),
    ],
)
def test_every_step_of_a_page_does_what_is_said(page: str, made: list[str], desk: Path) -> None:
    for step in steps_of(tutorial(page)):
        do(step)
    for name in made:
        assert (desk / name).stat().st_size > 0, name
    if page == "stand-on-a-leaderboard":
        require_board(desk / "boards" / "mine" / "leaderboard.csv")


def require_board(path: Path) -> None:
    """Look for the rows that a board of a user's network and pictures has."""
    rows = {row["name"]: row for row in csv.DictReader(path.open())}
    assert {"pictures of theirs", "network mine", "network builtin:"} < set(rows)
    assert rows["pictures of theirs"]["first_core_s"] == ""
    traced = [rows[name] for name in ("1 sample, fast", "4 samples, fast", "16 samples, fast")]
    for row in traced:
        assert row["kind"] == "path tracer, denoised" and row["processor"]
        assert float(row["first_core_s"]) > 0 < float(row["further_core_s"])
    # the toys' pictures are no path tracer's: what is traced has their shapes, not their light
    assert len({row["psnr_log_db_median"] for row in traced}) == 3
