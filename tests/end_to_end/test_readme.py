"""The commands of README, tutorials and how-to pages do what is said; those of all pages exist."""

import contextlib
import csv
import dataclasses
import json
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from infra.viewer.open_source import open_handlers, page_of
from pipeline.presets.registry import preset_settings
from storage.dataset.dataset import open_dataset
from storage.digests import sha256_of_file
from storage.extensions import is_reference
from storage.records.objects import write_objects_lock
from storage.records.scene import Scene
from storage.settings.described import settings_record
from tests.command_line import run_program, trilight
from tests.conftest import ROOT
from tests.end_to_end.production_kit import (
    SIXTEEN_SAMPLES,
    answer_of,
    copy_of_the_project,
    viewed,
)
from tests.for_each import for_each
from tests.infra.viewer.served_kit import served
from tests.pipeline.documents.dataset_by_hand import edit_manifest, locked
from tests.train.toy import toy_scene, write_toy_dataset

README = ROOT / "README.md"
DOCS = ROOT / "docs"
TUTORIALS = [
    DOCS / "tutorials" / f"{name}.md"
    for name in (
        "first-dataset",
        "your-own-objects",
        "train-and-judge",
        "look-around",
        "stand-on-a-leaderboard",
        "blender-and-back",
    )
]
"""In the order in which a reader does them: later ones use what the first ones made."""
SCRIPT = ROOT / "examples" / "whole_line.sh"
NOT_RUN_HERE = {". .venv/bin/activate", "make setup-all"}
"""What this test's own environment is."""


def _steps_of(page: Path) -> Iterator[tuple[str, str]]:
    """Yield what a reader of a page or a script does, in its order, after `sh` or `python`.

    A step is a command on one line, without comments, or a whole block of Python.
    """
    whole = page.read_text()
    blocks = re.findall(r"```(sh|python)\n(.*?)```", whole, re.DOTALL)
    for language, text in blocks if page.suffix == ".md" else [("sh", whole)]:
        if language == "python":
            yield language, text
            continue
        lines = (line.split(" #")[0].strip() for line in text.replace("\\\n", " ").splitlines())
        yield from (("sh", line) for line in lines if line and not line.startswith("#"))


def _shell_lines(page: Path) -> list[str]:
    return [text for language, text in _steps_of(page) if language == "sh"]


AGENTS = ROOT / "AGENTS.md"
PAGES = [README, AGENTS, ROOT / "CONTRIBUTING.md", SCRIPT, *sorted(DOCS.rglob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SHOWN = re.findall(r"^    (trilight .*)$", "".join(e.read_text() for e in EXAMPLES), re.MULTILINE)
USED = sorted({*SHOWN, *(line for page in PAGES for line in _shell_lines(page))})
"""Every command that a person is told to type."""


def _trilight_words(line: str) -> list[str]:
    """Return what follows `trilight` on a line, also behind torchrun; nothing of other commands."""
    words = shlex.split(line, comments=True)
    for name in ("trilight", "infra.cli.app"):
        if name in words:
            return words[words.index(name) + 1 :]
    return []


SUBMISSIONS = [["submit", name] for name in ("slurm", "kubernetes", "make-by-array")]


def _command(words: list[str]) -> tuple[str, ...]:
    is_within = words[0] == "shards" or words[:2] in SUBMISSIONS
    return tuple(words[: 2 if is_within else 1])


COMMANDS = sorted({_command(words) for line in USED if (words := _trilight_words(line))})


def test_readme_and_tutorials_show_commands() -> None:
    for page in (README, *TUTORIALS[1:], SCRIPT):
        assert any(_trilight_words(line) for line in _shell_lines(page)), page
    assert {*TUTORIALS, DOCS / "tutorials" / "index.md"} == set(DOCS.glob("tutorials/*.md"))


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_commands_and_their_options_exist(command: tuple[str, ...]) -> None:
    # names of options are cut off in narrow tables
    ended = trilight([*command, "--help-all"], env={"COLUMNS": "300"})
    assert ended.exit_code == 0, command
    shown = ended.stdout
    for line in USED:
        words = _trilight_words(line)
        if words and _command(words) == command:
            for option in (word for word in words if re.match(r"--(?!extend)[a-z]", word)):
                assert re.search(rf"{option.split('=')[0]}(?![\w-])", shown), line


def test_targets_of_make_exist() -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in USED:
        if line.startswith("make "):
            assert line.split()[1] in targets, line


@pytest.mark.parametrize("name", ["README", "AGENTS", "DECISIONS", "CONTRIBUTING"])
def test_links_lead_somewhere(name: str) -> None:
    """Those between the pages of docs/ are held by its strict build."""
    text = (ROOT / f"{name}.md").read_text()
    for target in re.findall(r"\[[^\]]*\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (ROOT / target).exists(), target


def _run(command: str, folder: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL")}
    path = f"{ROOT / '.venv' / 'bin'}:{environment['PATH']}"
    run_program(["sh", "-c", command], folder, env=environment, timeout=1500, PATH=path)


def _view(command: str, folder: Path) -> None:
    """Open the page that `trilight view` serves, and end it."""
    words = [str(ROOT / ".venv" / "bin" / "trilight"), *shlex.split(command)[1:]]
    with viewed(words, folder) as address:
        assert b"<title>Trilight view</title>" in answer_of(address, "")


@pytest.mark.slow("commands")
@pytest.mark.timeout(1800)
def test_the_commands_run(tmp_path: Path, shared: Path) -> None:
    """README's, in order; only its objects, dataset and training are fewer."""
    copy_of_the_project(tmp_path)
    objects = tmp_path / "objects"
    rows = (shared / "objects/objects.jsonl").read_text().splitlines()[2:32:2]  # of all splits
    for path in (json.loads(row)["path"] for row in rows):
        (objects / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(shared / "objects" / path, objects / path)
    (objects / "objects.jsonl").write_text("\n".join(rows) + "\n")
    for command in _shell_lines(README):
        if command in NOT_RUN_HERE:
            continue
        command = command.replace("FOLDER", shlex.quote(str(objects)))
        # one scene a shard: eight have all three splits
        fewer = "--scenes 8 --resolution 64 --set splits.scenes_per_shard=1"
        fewer += f" {' '.join(SIXTEEN_SAMPLES)}"
        command = command.replace("--scenes 64", fewer)
        # set-up would lead the environment, which is lent, to the copy
        lent = "--old-file .venv/.dataset-ready"
        command = command.replace("make dataset", f"make {lent} dataset SCENES=1")
        if command.startswith("trilight view"):
            _view(command, tmp_path)
        else:
            _run(command.replace("--out runs/readme", "--out runs/readme --steps 4"), tmp_path)
    made = tmp_path / "data" / "smoke"
    with Image.open(made / "contact_sheet.png") as sheet:
        assert min(sheet.size) > 200
        assert len(sheet.getcolors(1 << 24) or []) > 1000  # pictures, not an empty sheet
    assert open_dataset(str(made)).digest in (made / "README.md").read_text()
    for name in ("LICENSE.md", "attribution.csv", "croissant.json", "report.html"):
        assert (made / name).stat().st_size > 100
    assert (tmp_path / "runs" / "readme" / "validation_sheet.png").exists()


@pytest.mark.slow("commands")
@pytest.mark.timeout(5400)
@pytest.mark.skipif(
    "TRILIGHT_TUTORIALS" not in os.environ,
    reason="the tutorials take two cores about an hour: set TRILIGHT_TUTORIALS=1",
)
def test_the_tutorials_run(tmp_path: Path) -> None:
    copy_of_the_project(tmp_path)
    _run("make dataset", tmp_path)
    for language, text in (step for page in TUTORIALS for step in _steps_of(page)):
        if language == "python":
            (tmp_path / "block.py").write_text(text)
            _run("python block.py", tmp_path)
        elif text.startswith("trilight view"):
            _view(text, tmp_path)
        else:
            _run(text, tmp_path)
    made_by_pages = (
        "runs/mine/validation_sheet.png",
        "data/both.png",
        "boards/mine/leaderboard.png",
    )
    for made in made_by_pages:
        assert (tmp_path / made).stat().st_size > 10_000


@pytest.mark.slow("commands")
@pytest.mark.timeout(1800)
def test_the_whole_line_runs(tmp_path: Path) -> None:
    copy_of_the_project(tmp_path)
    _run("OBJECTS=builtin:12 SCENES=6 NOISE_FLOOR=5 STEPS=4 sh examples/whole_line.sh", tmp_path)
    assert (tmp_path / "data" / "whole-line" / "both.png").stat().st_size > 1_000
    assert (tmp_path / "runs" / "whole-line" / "evaluation" / "evaluation.md").exists()


OWN_PAGES = [
    ROOT / "CONTRIBUTING.md",
    *(p for p in sorted(DOCS.glob("how-to/*.md")) if "/examples/" in p.read_text()),
]
"""Of those who add something of their own."""
SCREEN = 60
"""Lines of a page: what is seen without scrolling, or once."""


@for_each("page", OWN_PAGES)
def test_a_page_is_one_screen_and_names_what_exists(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= SCREEN or page.name == "CONTRIBUTING.md"
    for named in re.findall(r"`([\w/.-]+/[\w.-]*)`", text):
        if named.split("/")[0] in ("data", "runs"):
            continue
        assert (ROOT / named).exists(), named
    for word in (word for line in _shell_lines(page) for word in shlex.split(line)):
        path = word.rpartition(":")[0] if is_reference(word) else word
        if path.startswith(("tests/", "examples/")):
            assert (ROOT / path).exists(), word


def test_every_example_has_a_page_and_every_page_a_command() -> None:
    texts = "".join(page.read_text() for page in OWN_PAGES)
    for example in EXAMPLES:
        assert f"](../../examples/{example.name})" in texts, example.name
    assert all(_shell_lines(page) for page in OWN_PAGES)


PX = 16
"""Width of the toys' pictures, where the pages have 64."""
SMOKE = settings_record(preset_settings("smoke"))
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


def toy_room(index: int) -> Scene:
    """Return a toy scene whose objects say what they are."""
    scene = toy_scene(index)
    named = (
        dataclasses.replace(each, uid=f"{index}") if each.kind == "object" else each
        for each in scene.objects
    )
    return dataclasses.replace(scene, objects=tuple(named))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return a reader's folder, with what the pages before have made; it is the working one.

    Toy scenes stand where those pages have made theirs.
    """
    desk = tmp_path_factory.mktemp("desk")
    splits = ["train"] * 3 + ["validation"]
    dataset = write_toy_dataset(
        desk / "data" / "mine", train=3, validation=1, resolution=PX, scene_of=toy_room
    )
    objects = [locked(f"{row}", split=split) for row, split in enumerate(splits)]
    write_objects_lock(dataset.folder.objects_lock, objects)
    digest = sha256_of_file(dataset.folder.objects_lock)
    told = {**SMOKE, "renders": {**SMOKE["renders"], "resolution": PX}}
    edit_manifest(dataset, objects_lock_sha256=digest, settings=told)
    dataset.folder.card.write_text("# Toys\n")
    with contextlib.chdir(desk):
        began = "train smoke --data data/mine --out runs/mine --steps 2".split()
        assert trilight([*began, *SMALL]).exit_code == 0
        yield desk


def do(language: str, text: str) -> None:
    """Do what a page says: a training is a short one, and a page is asked what it asks first."""
    if language == "python":
        text = text.replace("resolution=64", f"resolution={PX}")
        exec(compile(text, "a tutorial", "exec"), {})
        return
    name, *words = shlex.split(TOYS.get(text, text))
    assert name == "trilight", text
    if words[0] == "view":
        page = page_of(words[1])
        with served(open_handlers(words[1], checkpoint=None, threads=1), page) as asker:
            status, told, _ = asker.ask(f"api/{ASKED[page]}")
            assert status == 200 and told, words[1]
        return
    if words[0] == "train":
        words = [re.sub(r"^(num_steps=)?(\d)0$", r"\1\2", word) for word in words] + SMALL
    ended = trilight(words)
    assert ended.exit_code == 0, (words, ended.output)


@pytest.mark.slow("commands")
@pytest.mark.timeout(900)
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
    for step in _steps_of(DOCS / "tutorials" / f"{page}.md"):
        do(*step)
    for name in made:
        assert (desk / name).stat().st_size > 0, name
    if page == "stand-on-a-leaderboard":  # rows of a user's network and pictures
        with (desk / "boards" / "mine" / "leaderboard.csv").open() as stream:
            rows = {row["name"]: row for row in csv.DictReader(stream)}
        assert {"pictures of theirs", "network mine", "network builtin:"} < set(rows)
        assert rows["pictures of theirs"]["first_core_s"] == ""
        traced = [rows[f"{samples}, fast"] for samples in ("1 sample", "4 samples", "16 samples")]
        for row in traced:
            assert row["kind"] == "path tracer, denoised" and row["processor"]
            assert float(row["first_core_s"]) > 0 < float(row["further_core_s"])
        # the toys' pictures are no path tracer's: what is traced has their shapes, not their light
        assert len({row["psnr_log_db_median"] for row in traced}) == 3
