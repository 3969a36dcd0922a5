"""The commands of README, tutorials and how-to pages do what is said; those of all pages exist."""

import json
import os
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from storage.dataset.dataset import open_dataset
from storage.extensions import is_reference
from tests.command_line import run_program, trilight
from tests.conftest import ROOT
from tests.end_to_end.production_kit import (
    SIXTEEN_SAMPLES,
    answer_of,
    copy_objects,
    copy_of_the_project,
    shell_lines,
    steps_of,
    tutorial,
    viewed,
)
from tests.for_each import for_each

README = ROOT / "README.md"
TUTORIALS = [
    tutorial(name)
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


def _shell_lines(page: Path) -> list[str]:
    """Return the commands of a page's `sh` blocks, or of a script, without comments."""
    text = page.read_text()
    if page.suffix == ".md":
        text = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    return shell_lines(text)


AGENTS = ROOT / "AGENTS.md"
PAGES = [README, AGENTS, ROOT / "CONTRIBUTING.md", SCRIPT, *sorted((ROOT / "docs").rglob("*.md"))]
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
    assert set(TUTORIALS) == set((ROOT / "docs" / "tutorials").glob("*.md")) - {
        ROOT / "docs" / "tutorials" / "index.md"
    }


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
    rows = [json.loads(row) for row in (shared / "objects/objects.jsonl").open()]
    objects = copy_objects(
        shared / "objects", tmp_path / "objects", rows[2:32:2]
    )  # of all three splits
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
    for step in (step for page in TUTORIALS for step in steps_of(page)):
        if step.language == "python":
            (tmp_path / "block.py").write_text(step.text)
            _run("python block.py", tmp_path)
        elif step.text.startswith("trilight view"):
            _view(step.text, tmp_path)
        else:
            _run(step.text, tmp_path)
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
    *(p for p in sorted((ROOT / "docs" / "how-to").glob("*.md")) if "/examples/" in p.read_text()),
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
