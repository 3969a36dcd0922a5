"""Licences: who is let in, what is stated from outside, and the form of an identifier."""

from pathlib import Path
from typing import Any

import pytest

from pipeline.objects.licences import DEFAULT_ALLOWED, USER_PROVIDED, refuse_licences
from pipeline.objects.sources import find_objects
from storage.errors import TrilightError
from storage.records.objects import ObjectRecord
from tests.for_each import for_each


def record(uid: str, licence: str) -> ObjectRecord:
    return ObjectRecord(
        uid=uid,
        path="",
        title="",
        licence=licence,
        licence_source="tests",
        attribution="",
        source_url="",
    )


def test_the_default_refuses_what_is_unknown_or_restricted() -> None:
    allowed = ["CC0-1.0", "cc-by-4.0", "MIT", USER_PROVIDED]
    refused = ["LicenseRef-unknown", "CC-BY-NC-4.0", "CC-BY-ND-4.0", "CC-BY-NC-SA-4.0", "", "GPL"]
    records = [record(licence, licence) for licence in allowed + refused]
    kept, failures = refuse_licences(records, DEFAULT_ALLOWED)
    assert [one.uid for one in kept] == allowed
    assert [failure.item for failure in failures] == refused
    assert {(failure.stage, failure.reason) for failure in failures} == {
        ("objects", "licence_refused")
    }
    assert not any(mark in name for name in DEFAULT_ALLOWED for mark in ("NC", "ND", "unknown"))


def test_a_refusal_says_how_to_allow() -> None:
    one = record("a", "CC-BY-NC-4.0")
    _, (failure,) = refuse_licences([one], DEFAULT_ALLOWED)
    assert "--allow-licence 'CC-BY-NC-4.0'" in failure.message
    assert refuse_licences([one], (*DEFAULT_ALLOWED, "CC-BY-NC-4.0")) == ([one], [])


def test_compound_expressions_are_allowed_as_they_stand() -> None:
    one = record("a", "MIT OR Apache-2.0")
    _, (failure,) = refuse_licences([one], DEFAULT_ALLOWED)
    assert "--allow-licence 'MIT OR Apache-2.0'" in failure.message
    assert refuse_licences([one], ["mit or apache-2.0"]) == ([one], [])


@for_each("licence", ["", "CC BY 4.0", "x" * 65, "Größe"])
def test_what_is_no_identifier_is_to_be_mended(licence: str) -> None:
    """No allow-list can name it, so the message must not say so."""
    _, (failure,) = refuse_licences([record("a", licence)], DEFAULT_ALLOWED)
    assert "--allow-licence" not in failure.message
    assert "expected an SPDX identifier" in failure.message


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    return tmp_path


def test_a_stated_licence_is_that_of_silent_files(folder: Path) -> None:
    found = find_objects(
        str(folder), work_dir=folder, allowed_licences=["CC-BY-4.0"], licence="cc-by-4.0"
    )
    (one,) = found.records
    assert (one.licence, one.licence_source) == ("cc-by-4.0", "stated by the user (--licence)")


def test_a_stated_licence_must_be_allowed_too(folder: Path) -> None:
    found = find_objects(
        str(folder), work_dir=folder, allowed_licences=DEFAULT_ALLOWED, licence="CC-BY-NC-4.0"
    )
    assert not found.records
    assert [failure.reason for failure in found.failures] == ["licence_refused"]


@pytest.mark.parametrize("name", ["objects.jsonl", "objects.csv", "builtin:", "objaverse:"])
def test_sources_that_state_their_own(folder: Path, name: str) -> None:
    source = name if name.endswith(":") else str(folder)
    if source != name:
        (folder / name).write_text("")
    with pytest.raises(TrilightError, match=f"--licence is 'MIT', but {name} states"):
        find_objects(source, work_dir=folder, allowed_licences=["MIT"], licence="MIT")


BAD = ["", " ", "CC BY", "CC-BY-4.0\n", "a/b", "x" * 65, "LicenseRef-größe", "a:b", "(MIT)"]


def test_malformed_identifiers(folder: Path) -> None:
    stated: list[dict[str, Any]] = [{"allowed_licences": ["MIT"], "licence": one} for one in BAD]
    for options in (*stated, *({"allowed_licences": [one]} for one in BAD)):
        with pytest.raises(TrilightError, match="expected an SPDX identifier") as caught:
            find_objects(str(folder), work_dir=folder, **options)
        assert "\n" not in str(caught.value), options


@pytest.mark.parametrize(
    "licence", ["MIT", "CC-BY-SA-4.0", "GPL-2.0+", "LicenseRef-My.Shop-1", "x" * 64]
)
def test_well_formed_identifiers(folder: Path, licence: str) -> None:
    (one,) = find_objects(
        str(folder), work_dir=folder, allowed_licences=[licence], licence=licence
    ).records
    assert one.licence == licence
