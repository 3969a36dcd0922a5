"""The how-to pages of extensions and CONTRIBUTING.md: what they link to, name and show exists."""

import re
import shlex
from pathlib import Path

from infra.setup.generated_pages import PAGES as GENERATED
from storage.extensions import is_reference
from tests.command_line import trilight
from tests.conftest import ROOT
from tests.for_each import for_each

PAGES = [
    ROOT / "CONTRIBUTING.md",
    *(p for p in sorted((ROOT / "docs" / "how-to").glob("*.md")) if "/examples/" in p.read_text()),
]
"""Of those who add something of their own; test_readme holds the commands of all pages."""
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SCREEN = 60
"""Lines of a page: what is seen without scrolling, or once."""


def _commands(page: Path) -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
    return [shlex.split(line) for block in blocks for line in block.splitlines() if line]


def _shown_in(example: Path) -> list[list[str]]:
    lines = re.findall(r"^    (trilight .*)$", example.read_text(), re.MULTILINE)
    return [shlex.split(line) for line in lines]


COMMANDS = [words for page in PAGES for words in _commands(page)]
SHOWN = [words for example in EXAMPLES for words in _shown_in(example)]
NAMES = sorted({words[1] for words in [*COMMANDS, *SHOWN] if words[0] == "trilight"})


@for_each("page", PAGES)
def test_a_page_is_one_screen_and_leads_somewhere(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= SCREEN or page.name == "CONTRIBUTING.md"
    for target in re.findall(r"\[[^\]]*\]\(([^)#:]+)\)", text):
        is_generated = Path(target).stem in GENERATED
        assert is_generated or (page.parent / target).exists(), target
    for named in re.findall(r"`([\w/.-]+/[\w.-]*)`", text):
        if named.split("/")[0] in ("data", "runs"):
            continue
        assert (ROOT / named).exists(), named


def test_every_example_has_a_page_and_every_page_a_command() -> None:
    texts = "".join(page.read_text() for page in PAGES)
    for example in EXAMPLES:
        assert f"](../../examples/{example.name})" in texts, example.name
    assert all(_commands(page) for page in PAGES)


@for_each("name", NAMES)
def test_options_that_are_shown_exist(name: str) -> None:
    known = trilight([name, "--help"], env={"COLUMNS": "300"}).stdout
    for words in (*COMMANDS, *SHOWN):
        if words[:2] == ["trilight", name]:
            options = [word for word in words if word.startswith("--") and word != "--extend"]
            assert [option for option in options if option not in known] == []


def test_files_that_are_named_exist() -> None:
    for words in COMMANDS:
        for word in words:
            path = word.rpartition(":")[0] if is_reference(word) else word
            if path.startswith(("tests/", "examples/")):
                assert (ROOT / path).exists(), word
