"""`env:NAME`: a source of the worker's environment, no other variable, and never what it says."""

from pathlib import Path

import pytest

from storage.errors import TrilightError
from storage.remote import tries
from tests.pipeline.objects.find_kit import find

CANARY = "hunter2-secret-value"


@pytest.mark.parametrize("name", ["PATH", "AWS_SECRET_ACCESS_KEY", "TRILIGHT_CACHE", "", "A\nB"])
def test_only_variables_of_sources_are_read(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    if name.isidentifier():
        monkeypatch.setenv(name, CANARY)
    with pytest.raises(TrilightError, match="begins with TRILIGHT_SOURCE_") as caught:
        find(f"env:{name}")
    assert CANARY not in str(caught.value)


def test_the_source_that_it_says_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0")
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path))
    assert [record.uid for record in find("env:TRILIGHT_SOURCE_MINE").records] == ["a"]


VALUES = (
    CANARY,
    f"/no/{CANARY}'quoted\nand more",
    f"https://me:{CANARY}@127.0.0.1:9/{CANARY}?key={CANARY}",
    f"ftp://{CANARY}/x",
    f"s3://me:{CANARY}@bucket/x",
    f"pipe:cat {CANARY}",
    f"builtin:{CANARY}",
    f"objaverse:{CANARY}",
)


def test_no_message_shows_what_it_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tries, "PAUSE_S", 0.0)
    monkeypatch.setenv("TRILIGHT_CACHE", str(tmp_path / "cache"))
    for value in VALUES:
        monkeypatch.setenv("TRILIGHT_SOURCE_MINE", value)
        with pytest.raises(TrilightError) as caught:
            find("env:TRILIGHT_SOURCE_MINE")
        message = str(caught.value)
        assert "env:TRILIGHT_SOURCE_MINE" in message, value
        assert "does not exist" in message or value != CANARY
        for part in ("hunter2", "127.0.0.1", "bucket", "quoted"):
            assert part not in message, value
        assert caught.value.__cause__ is None and caught.value.__suppress_context__, value


def test_an_empty_folder_is_named_by_its_variable(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / CANARY).mkdir()
    monkeypatch.setenv("TRILIGHT_SOURCE_MINE", str(tmp_path / CANARY))
    with pytest.raises(TrilightError, match="^objects 'env:TRILIGHT_SOURCE_MINE'") as caught:
        find("env:TRILIGHT_SOURCE_MINE")
    assert CANARY not in str(caught.value)
