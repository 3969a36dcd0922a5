"""The test of a file is where its name says: tests/a/b/test_c.py tests a/b/c.py."""

from collections import defaultdict
from pathlib import Path

from infra.setup.wheel_tree import PACKAGES
from tests.conftest import ROOT

TESTS = ROOT / "tests"
BESIDE = {"architecture", "end_to_end", "extremes", "hostile", "laws", "references"}
"""Folders of tests that are about no single file."""


def _tests() -> list[Path]:
    found = (path.relative_to(TESTS) for path in TESTS.rglob("test_*.py"))
    return sorted(path for path in found if path.parts[0] not in BESIDE)


def test_every_folder_of_tests_is_a_folder_of_the_product() -> None:
    folders = {path.parent for path in _tests()}
    assert len(folders) > 20, "the walk finds the tests"
    assert [str(folder) for folder in folders if not (ROOT / folder).is_dir()] == []


def test_a_test_that_is_named_for_a_file_is_at_its_place() -> None:
    """A name that several files of a package have says which by its place."""
    places = defaultdict[tuple[str, str], set[Path]](set)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            places[package, path.stem].add(path.relative_to(ROOT).parent)
    misplaced = {}
    for test in _tests():
        wanted = places[test.parts[0], test.stem.removeprefix("test_")]
        if wanted and test.parent not in wanted:
            misplaced[str(test)] = sorted(map(str, wanted))
    assert misplaced == {}
