"""JSON is read by its type: what it is not is one sentence that names file, field and value."""

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest

from storage.atomic import append_line
from storage.errors import TrilightError
from storage.settings.ranges import Within
from storage.typed_json import FINITE, Sha256, read_json, read_json_lines
from tests.for_each import for_each


@dataclass(frozen=True, kw_only=True)
class Note:
    count: Annotated[int, Within(0, 10**9, unit="shards")]
    digest: Sha256 | None = None
    rest: Annotated[Mapping[str, Any], FINITE] | None = None
    within: "tuple[Note, ...]" = ()


WRONG = {
    '{"count": "4"}': r"file: count is '4'; expected a whole number from 0 to 1000000000 shards\.",
    '{"count": 4.0}': r"count is 4\.0; expected a whole number",
    '{"count": true}': "count is True",
    '{"count": -1}': "count is -1",
    '{"count": 1000000001}': "count is 1000000001",
    '{"count": ' + "9" * 10_000 + "}": r"not JSON \(number out of range",
    '{"count": NaN}': "count is nan",
    '{"count": 1, "digest": "' + "A" * 64 + '"}': "digest is 'A+'; expected 64 hexadecimal digits",
    '{"count": 1, "digest": "' + "0" * 64 + '\\n"}': "digest is '0+.n'; expected",
    '{"count": 1, "rest": {"a": [1e999]}}': "rest is .*; expected JSON values with finite numbers",
    '{"count": 1, "rest": {"a": ' + "[" * 100_000 + "]" * 100_000 + "}}": "recursion limit",
    '{"count": 1, "within": [{"count": 1}, {"count": -2}]}': r"file: within\.1\.count is -2",
    '{"count": 1, "evil": 2}': "file: evil does not exist; expected one of count, digest",
    '{"count": "' + "x" * 10**6 + '"}': "count is 'xxx.*xxx'; expected",
    "{}": "count is missing",
    "[]": r"all of it is \[\]",
    "null": "file: null",
    '{"count": 1} {}': "not JSON",
    '{"count": 1': "not JSON",
}


@for_each("text, message", WRONG.items())
def test_what_a_file_is_not_is_one_sentence_within_a_second(text: str, message: str) -> None:
    began = time.process_time()
    with pytest.raises(TrilightError) as caught:
        read_json(text, Note, "file")
    assert time.process_time() - began < 1
    assert re.search(message, str(caught.value)), str(caught.value)
    assert str(caught.value).startswith("file: ") and len(str(caught.value)) < 500


def test_a_durable_line_takes_the_place_of_one_that_a_kill_has_cut(tmp_path: Path) -> None:
    path = tmp_path / "new" / "log"
    append_line(path, "one", durable=True)
    for torn in (b"", b"tw", b"\0"):
        path.write_bytes(b"one\n" + torn)
        append_line(path, "two", durable=True)
        assert path.read_bytes() == b"one\ntwo\n"
    path.write_bytes(b"tw")
    append_line(path, "two", durable=True)
    append_line(path, "three")
    assert path.read_bytes() == b"two\nthree\n"
    with pytest.raises(TrilightError, match="cannot write"):
        append_line(tmp_path, "x")


def test_lines_forgive_an_end_that_a_kill_has_cut_and_nothing_else() -> None:
    whole = b'{"count": 1}\n{"count": 2}\n'
    for torn in (b"", b'{"cou', b"\xff\xff", b"\0\0\0"):
        rows = read_json_lines(whole + torn, Note, "log", torn_end=True)
        assert rows == [Note(count=1), Note(count=2)]
    with pytest.raises(TrilightError, match="log:3: all of it is not JSON"):
        read_json_lines(whole + b"\xff", Note, "log")
    for wrong in (b"\xff\n", b"\xff\n" + whole):
        with pytest.raises(TrilightError, match="log:3: "):
            read_json_lines(whole + wrong, Note, "log", torn_end=True)
