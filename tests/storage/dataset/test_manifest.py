"""A manifest is read in pieces and kept small: the same for any cut, and few bytes a sample."""

import io
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from infra.bench.subjects.manifests import memory_of_opening, write_manifest_of
from storage.dataset import json_pieces
from storage.dataset.json_pieces import entries
from storage.dataset.manifest import MemberTable

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=12,
)
ROWS = st.lists(
    st.tuples(st.from_regex(r"[0-9a-z]+\.[a-z.]+", fullmatch=True), *[st.integers(0, 2**62)] * 2)
)


def read(text: str, piece_bytes: int = 1) -> list[tuple[str, Any]]:
    before, json_pieces.PIECE_BYTES = json_pieces.PIECE_BYTES, piece_bytes
    try:
        return list(entries(io.BytesIO(text.encode())))
    finally:
        json_pieces.PIECE_BYTES = before


@settings(deadline=None)  # a busy machine is no failure
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


@pytest.mark.parametrize(
    "text",
    ["", "[]", "3", "{", '{"a"', '{"a": 1', '{"a": 1,}', '{"a": [1,]}', '{"a": [1 2]}',
     '{"a" 1}', "{1: 2}", '{"a": 1} 2', '{"a": tru}', '{"a": [1}', '{"a": 1 "b": 2}'],
)  # fmt: skip
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        read(text)


@settings(deadline=None)  # a busy machine is no failure
@given(ROWS)
def test_a_table_gives_its_rows_back(rows: list[tuple[str, int, int]]) -> None:
    table = MemberTable(rows)
    assert (list(table), len(table), table) == (rows, len(rows), MemberTable(iter(rows)))
    assert table != MemberTable([*rows, ("a.b", 0, 1)])
    assert hash(table) == hash(MemberTable(rows))


def test_opening_a_large_dataset_takes_few_bytes_a_sample(tmp_path: Path) -> None:
    """As Python objects, the index alone took 1.9 kB a sample (measured), its text 0.4 kB more."""
    write_manifest_of(tmp_path, 50_000)
    taken = memory_of_opening(tmp_path)["peak_bytes"]
    # measured: 115 bytes, most of them one piece of the text, and 8 a hash, three times over while
    # they are sorted; 307 where the index is kept
    assert taken < 50_000 * 160
