"""A manifest is read in pieces and kept small: the same for any cut, and few bytes a sample."""

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from storage.dataset import json_pieces
from storage.dataset.json_pieces import entries
from storage.dataset.manifest import decode_head, read_head, read_manifest, write_manifest
from tests.for_each import for_each
from tests.storage.dataset.manifests_kit import (
    SAMPLES_PER_SHARD,
    memory_of_opening,
    write_manifest_of,
)

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


def read(text: str, piece_bytes: int = 1) -> list[tuple[str, Any]]:
    before, json_pieces.PIECE_BYTES = json_pieces.PIECE_BYTES, piece_bytes
    try:
        return list(entries(io.BytesIO(text.encode())))
    finally:
        json_pieces.PIECE_BYTES = before


@settings(deadline=None, max_examples=40)  # a busy machine is no failure
@given(st.dictionaries(st.text(), JSON), st.sampled_from([None, 1]), st.sampled_from([1, 7, 4096]))
def test_entries_are_those_of_the_object(
    record: dict[str, Any], indent: int | None, piece_bytes: int
) -> None:
    expected = [
        (name, item)
        for name, value in record.items()
        for item in (value if isinstance(value, list) else [value])
    ]
    text = json.dumps(record, indent=indent, ensure_ascii=False)
    assert read(f" {text}\n", piece_bytes) == expected


@for_each(
    "text",
    ["", "[]", "3", "{", '{"a"', '{"a": 1', '{"a": 1,}', '{"a": [1,]}', '{"a": [1 2]}',
     '{"a" 1}', "{1: 2}", '{"a": 1} 2', '{"a": tru}', '{"a": [1}', '{"a": 1 "b": 2}'],
)  # fmt: skip
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        read(text)


def test_a_head_is_read_without_the_list_and_says_the_same(tmp_path: Path) -> None:
    write_manifest_of(tmp_path, 5_000)
    path = tmp_path / "manifest.json"
    whole, head = read_manifest(path), read_head(path)
    assert len(whole.shards) == 20 and head == dataclasses.replace(whole, shards=())
    cut = path.read_bytes()[: path.read_bytes().index(b"train-000001")]  # as a maker fetches it
    assert decode_head(io.BytesIO(cut), "here") == head


def test_rows_with_an_index_of_members_are_read(tmp_path: Path) -> None:
    """As manifests were before version 5."""
    write_manifest_of(tmp_path, 300)
    path = tmp_path / "manifest.json"
    record = json.loads(path.read_bytes())
    for row in record["shards"]:
        row["members"] = [["000000000.json", 512, 9]]
    older = tmp_path / "older.json"
    older.write_text(json.dumps({**record, "schema_version": 4}, indent=1, sort_keys=True))
    found = read_manifest(older)
    assert found.schema_version == 4 and found.shards == read_manifest(path).shards
    write_manifest(older, found)
    assert older.read_bytes() == path.read_bytes()


def test_a_shard_takes_200_bytes_of_a_manifest(tmp_path: Path) -> None:
    write_manifest_of(tmp_path, 1_000 * SAMPLES_PER_SHARD)
    assert (tmp_path / "manifest.json").stat().st_size < 1_000 * 220


def test_opening_a_large_dataset_takes_few_bytes_a_sample(tmp_path: Path) -> None:
    write_manifest_of(tmp_path, 100_000)
    taken = memory_of_opening(tmp_path)["peak_bytes"]
    assert taken < 100_000 * 40  # 390 shards; measured: 17, nearly all of it a piece of the text
