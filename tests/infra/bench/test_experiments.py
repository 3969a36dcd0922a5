"""Every experiment's declaration is whole, its points can be listed, and its results told."""

from collections import Counter
from pathlib import Path

import pytest

from infra.bench.catalogue import chosen, every_experiment, families
from infra.bench.choices import CHOICES, choices
from infra.bench.curve import columns_of, rows
from infra.bench.effort import CAREFUL, QUICK, Asked, Effort
from infra.bench.experiment import Experiment
from infra.bench.machine import ROOT
from infra.bench.pages import read_block, write_pages
from infra.bench.run import RESULTS, lacking, newest_run
from infra.bench.table import markdown
from storage.errors import TrilightError
from tests.for_each import case
from tests.infra.bench.bench_kit import TINY

EVERY = every_experiment()


def test_a_declaration_is_whole() -> None:
    for one in EVERY:
        with case(one.name):
            assert one.name == one.name.lower() and " " not in one.name
            assert one.about.endswith(".") and one.title
            columns = [column.name for column in columns_of(one)]
            assert len(set(columns)) == len(columns) and set(one.also_cost) <= set(columns)
            assert bool(one.against) == bool(one.error)
            for effort in (QUICK, CAREFUL, TINY):
                _can_be_listed(one, effort)


def _can_be_listed(one: Experiment, effort: Effort) -> None:
    points, turns = one.points(effort), one.turns(effort)
    names = [point.name for point in points]
    assert names and len(set(names)) == len(names)
    assert turns and len(set(turns)) == len(turns)
    assert sum(point.default for point in points) <= 1
    if one.because.startswith("Default"):
        assert effort is TINY or sum(point.default for point in points) == 1


def test_names_are_of_one_thing() -> None:
    assert max(Counter(one.name for one in EVERY).values()) == 1
    for name, family in families().items():
        # such a name would mean the experiment, and the rest of the family could not be named
        assert all(one.name != name for one in EVERY) or [one.name for one in family] == [name]
    assert chosen(["sampling", "samples"]) == list(families()["sampling"])
    with pytest.raises(TrilightError, match=r"experiment 'sample' is unknown; did you mean"):
        chosen(["sample"])


def test_what_is_missing_is_told() -> None:
    (economy,) = chosen(["economy"])
    assert "--data SET" in lacking(economy, Asked())
    assert lacking(economy, Asked(data="data/smoke")) == ""


def test_the_results_that_are_kept_can_be_told() -> None:
    for one in EVERY:
        with case(one.name):
            found = newest_run(RESULTS, one.name)
            if found is not None:
                assert len(list(markdown(one, found[0]))) == 2 + len(rows(one, found[0]))
                assert any(row.on_front for row in rows(one, found[0])) or one.error is None


def test_what_is_advised_is_measured_and_on_the_front_or_says_why() -> None:
    for choice in CHOICES:
        (one,) = chosen([choice.experiment])
        found = newest_run(RESULTS, one.name)
        assert found is not None
        marks = {row.point.name: row.on_front for row in rows(one, found[0])}
        assert marks[choice.point] or choice.despite, choice
    assert len(list(choices(RESULTS))) == 2 + len(CHOICES)


def test_the_block_of_a_page_is_that_of_the_result(tmp_path: Path) -> None:
    """Written anew from the results that are kept, it is what the page holds."""
    of_today = read_block(ROOT / "docs" / "tradeoffs.md", "bench guides")
    found = newest_run(RESULTS, "guides")
    assert found is not None and "| **16** |" in of_today
    (tmp_path / found[1].path.name).write_bytes(found[1].path.read_bytes())
    page = tmp_path / "page.md"
    page.write_text("<!-- bench guides:begin -->\nold\n<!-- bench guides:end -->\nafter\n")
    assert write_pages(tmp_path, (page,)) == [page]
    assert read_block(page, "bench guides") == of_today
    assert page.read_text().endswith("after\n")
    page.write_text("<!-- bench nothing:begin -->\n<!-- bench nothing:end -->\n")
    with pytest.raises(TrilightError, match="no such experiment"):
        write_pages(tmp_path, (page,))
