"""Documents are plain, short, and quote what their rows, the product and the links say.

Sentences are split as a reader would: at full stops, and at the ends of paragraphs and list items.
Code, tables and headings are no sentences.
"""

import ast
import json
import re
import statistics
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.for_each import case

DOCS = ROOT / "docs"
RESULTS = DOCS / "results"
README = ROOT / "README.md"
PAGES = [README, ROOT / "AGENTS.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
MEAN_WORDS, LONG = 15, 30
LONG_SHARE = {"README.md": 0.03}
"""Share of sentences with over LONG words; a page of few sentences may have one."""


def sentences_of(text: str) -> list[str]:
    """Return the sentences of a Markdown text."""
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)  # what the site reads
    for pattern in (r"```.*?```", r"^\s*\|.*$", r"^#.*$", r"!\[[^\]]*\]\([^)]*\)", r"^:::.*$"):
        text = re.sub(pattern, "", text, flags=re.DOTALL if "```" in pattern else re.MULTILINE)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    text = re.sub(r"^\s*(?:[-*]|\d+\.)\s+", "\n\n", text, flags=re.MULTILINE)
    paragraphs = (" ".join(paragraph.split()) for paragraph in re.split(r"\n\s*\n", text))
    ends = re.compile(r"(?<=[.!?:])(?:\*\*)?\s+(?=[\"'(*A-Z0-9`]|code)")
    return [each for paragraph in paragraphs for each in ends.split(paragraph) if words(each)]


def words(sentence: str) -> int:
    return len([word for word in sentence.split() if re.search(r"\w", word)])


def test_pages_are_plain() -> None:
    for page in PAGES:
        with case(page.relative_to(ROOT).as_posix()):
            counts = [words(each) for each in sentences_of(page.read_text())]
            long = sum(count > LONG for count in counts)
            share = LONG_SHARE.get(page.name, 0.05)
            assert statistics.mean(counts) <= MEAN_WORDS
            assert long <= max(share * len(counts), 0 if page == README else 1)


FIGURE = re.compile(r"(?<![\w.#-])\d[\d,]*(?:\.\d+)?(?![\w-])")


def figures_in(text: str) -> list[tuple[float, int]]:
    """Return the numbers of a text, and how many decimals each has."""
    found = (each.rstrip(",") for each in FIGURE.findall(text))
    return [(float(each.replace(",", "")), len(each.partition(".")[2])) for each in found]


def quotes(figure: float, decimals: int, known: Iterable[float]) -> bool:
    half = 0.5 * 10.0**-decimals
    return any(abs(value - figure) <= half * 1.000001 for value in known)


def links_of(page: Path) -> Iterator[tuple[str, Path]]:
    for text, target in re.findall(r"(?<!!)\[([^\]]*)\]\(([^)#:\s]+)", page.read_text()):
        yield text, page.parent / target


def test_figures_in_a_link_are_on_the_page_that_it_leads_to() -> None:
    quoted = 0
    for page in PAGES:
        for text, target in links_of(page):
            if target.suffix == ".md" and target.exists() and RESULTS in target.resolve().parents:
                known = [value for value, _ in figures_in(target.read_text())]
                for figure, decimals in figures_in(re.sub(r"`[^`]*`", "", text)):
                    quoted += 1
                    assert quotes(figure, decimals, known), f"{page.name}: {text}"
    assert quoted >= 8


SPECIAL = {
    "`faithful` (default)": "faithful",
    "`faithful`, without GPL": "faithful, GPL-free",
    "AdamW, 2,000 steps": "AdamW",
    "Muon, 2,000 steps": "Muon",
    "AdamW, 1,000 steps": "AdamW, half the steps",
    "Muon, 1,000 steps": "Muon, half the steps",
    "traced network, `builtin:hits`": "network builtin:",
    "pure network, `builtin:tokens`": "network builtin:tokens",
}
"""Point of the rows by the label of a table's row, where they differ."""

TABLES = [
    ("error-against-cost.md", "| target |", "frontier.jsonl", "trilight {}"),
    ("error-against-cost.md", "| target, both", "frontier-samplers.jsonl", "trilight {}"),
    ("which-network.md", "| 64 pixels |", "rungs-64.jsonl", "{}"),
    ("which-network.md", "| 256 pixels |", "rungs-256.jsonl", "{}"),
    ("beside-cycles.md", "| Trilight's image |", "agreement.jsonl", "stated {}"),
    ("meshes.md", "| 512 triangles", "profile.jsonl", "{}"),
    ("meshes.md", "| 4,096 triangles", "profile-4096.jsonl", "{}"),
    ("training-at-equal-cost.md", "| rate |", "learning-rates.jsonl", "{}, by width"),
    ("training-at-equal-cost.md", "| | error, % |", "optimisers.jsonl", "{}"),
]
"""Page, beginning of the table's head, its rows, and a row's point by its label."""


def test_tables_of_results_are_those_of_their_rows() -> None:
    for page, head, name, point in TABLES:
        known = statistics_of(RESULTS / name)
        lines = table_of((RESULTS / page).read_text(), head)
        assert lines, (page, head)
        for label, *cells in lines:
            with case(f"{page}, {label}"):
                label = label.removesuffix(" asked")
                label = re.sub(r"[\d.]+e-\d", lambda m: f"{float(m[0]):f}".rstrip("0"), label)
                of_rows = known[point.format(SPECIAL.get(label, label).replace("`", ""))]
                for cell in cells:
                    for figure, decimals in figures_in(re.sub(r"\(.*?\)", "", cell)):
                        assert quotes(figure, decimals, of_rows), cell


def table_of(text: str, head: str) -> list[list[str]]:
    """Return the cells of a table's rows, without its head."""
    lines = iter(text.splitlines())
    for line in lines:
        if line.startswith(head):
            next(lines)
            break
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    return rows


def statistics_of(path: Path) -> dict[str, list[float]]:
    """Return every statistic of every figure of a point, as they are and as shares or thousandths.

    Of a point's trials: mean, median, ends and twentieths, of all and of those of one width; and
    the mean difference of dB, and of percents, to those of the first point.
    """
    trials = defaultdict[str, list[tuple[str, dict[str, float]]]](list)
    for line in path.read_text().splitlines():
        row = json.loads(line)
        if "point" in row:
            figures = row.get("figures") or row["columns"]
            trials[row["point"]].append((row.get("turn") or "", figures))
    first = dict(next(iter(trials.values())))
    known = {}
    for point, all_of_it in trials.items():
        groups = defaultdict(list, {"": all_of_it})
        for turn, figures in all_of_it if "," in all_of_it[0][0] else ():
            groups[turn.partition(",")[0]].append((turn, figures))
        found: list[float] = []
        for group in groups.values():
            for name in all_of_it[0][1]:
                values = [f[name] for _, f in group if f.get(name) is not None]
                found += summaries(values)
        pairs = [(figures, first[turn]) for turn, figures in all_of_it if turn in first]
        if pairs and "db" in pairs[0][0]:
            found.append(abs(float(np.mean([a["db"] - b["db"] for a, b in pairs]))))
        if pairs and "percent" in pairs[0][0]:
            found.append(abs(float(np.mean([a["percent"] - b["percent"] for a, b in pairs]))))
        known[point] = [scale * value for value in found for scale in (1, 100, 1000)]
    return known


def summaries(values: list[float]) -> list[float]:
    if not values:
        return []
    ends = np.percentile(values, [0, 5, 50, 95, 100])
    return [float(np.mean(values)), *map(float, ends)]


def test_the_count_of_wrong_errors_is_that_of_the_rows() -> None:
    said = re.search(
        r"of (\d+) images of 200 unseen layouts, (\d+) were over 1 dB worse, (\d+) of them at 64",
        README.read_text(),
    )
    assert said is not None
    statement = json.loads((ROOT / "pipeline" / "renders" / "stated_errors.json").read_text())
    judged = statement["metrics"]["log"]["judged"]
    wrong = {px: round(each["over_1"] * each["pictures"]) for px, each in judged.items()}
    counts = sum(each["pictures"] for each in judged.values()), sum(wrong.values()), wrong["64"]
    assert counts == tuple(map(int, said.groups()))


def test_there_are_as_many_files_of_tests_as_is_said() -> None:
    said = re.search(r"\[(\d+)\+ files\]\(tests\)", README.read_text())
    assert said is not None
    assert len([*(ROOT / "tests").rglob("test_*.py")]) >= int(said[1])


TROUBLE = DOCS / "how-to" / "troubleshooting.md"
PRODUCT = ("infra", "pipeline", "storage", "train", "model", "scene_templates")


VALUES = re.compile(r"'[^']*'|\S*[\d/_]\S*|TEXT|\(\w+\)")
"""Names and values in a message."""


def test_errors_are_printed_as_the_product_prints_them() -> None:
    """Half of all three words in a row that are no name or value stand so in the sources."""
    errors = re.findall(r"^\| `([^|]+)` \| ", TROUBLE.read_text(), re.MULTILINE)
    assert len(errors) >= 25
    printed = set[tuple[str, ...]]().union(*map(word_triples, printed_texts()))
    for error in errors:
        with case(error):
            found = word_triples(VALUES.sub("\0", error))
            assert found and len(found & printed) >= 0.5 * len(found)


def word_triples(text: str) -> set[tuple[str, ...]]:
    """Return every three words in a row; none goes over the place of a value."""
    parts = [part.split() for part in text.split("\0")]
    return {triple for words in parts for triple in zip(words, words[1:], words[2:], strict=False)}


def printed_texts() -> Iterator[str]:
    """Yield the texts of the product's sources that could be messages."""
    for package in PRODUCT:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                yield text_of(node).replace("`", "")


def text_of(node: Any) -> str:
    """Return a text, with the places of values as zeros; of other nodes nothing."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%[sd]", "\0", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) for part in node.values)
    return "\0" if isinstance(node, ast.FormattedValue) else ""


@pytest.mark.parametrize("page", [README, ROOT / "AGENTS.md", ROOT / "CHANGELOG.md"], ids=str)
def test_no_page_names_a_place_to_clone_from(page: Path) -> None:
    assert not re.search(r"git clone|git@", page.read_text())


def test_the_version_is_the_same_everywhere() -> None:
    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert version is not None
    assert f"version: {version[1]}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {version[1]}\n" in (ROOT / "CHANGELOG.md").read_text()
    assert f"version = {{{version[1]}}}" in README.read_text()
