"""Claims: one holder at a time, free again when the holder ends, and the first writer wins.

JSON is read by its type: what it is not is one sentence that names file, field and value. Digests
of open files.
"""

import errno
import fcntl
import io
import itertools
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import pytest
import torch

from pipeline.assets.asset_store import AssetStore
from storage import file_locks
from storage.atomic import append_line, atomic_writer, write_error
from storage.dataset.layout import DatasetFolder
from storage.digests import sha256_hex, sha256_of_stream
from storage.errors import EnvironmentFailure, TrilightError
from storage.file_locks import describe_holder, hold_lock, is_locked
from storage.remote.shard_cache import ShardCache
from storage.settings.ranges import Within
from storage.typed_json import FINITE, Sha256, read_json, read_json_lines
from tests.conftest import ROOT
from tests.for_each import case, for_each
from tests.storage.remote.cache_readers import remote
from train.folder import RunFolder, claim_run
from train.loop.distributed import DistributedContext

HOLD = """
import sys, time
from pathlib import Path
from storage.file_locks import hold_lock
with hold_lock(Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    time.sleep(60)
"""


def test_a_claim_has_one_holder_and_ends_with_its_process(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "a.claim"
    with hold_lock(path) as first, hold_lock(path) as second:
        assert first
        assert not second
    with hold_lock(path) as third:
        assert third
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        with hold_lock(path) as ours:
            assert not ours
        holder.send_signal(signal.SIGKILL)
    with hold_lock(path, wait=True) as ours:
        assert ours


def test_a_claim_that_its_holder_deleted_is_not_shared(tmp_path: Path) -> None:
    """Who waited for the old file must not hold it while another holds a new one of that name."""
    path, waited = tmp_path / "samples" / "a.claim", threading.Event()
    held_together: list[bool] = []

    def wait() -> None:
        with hold_lock(path, wait=True), hold_lock(path) as again:
            held_together.append(again)
        waited.set()

    with hold_lock(path):
        waiter = threading.Thread(target=wait)
        waiter.start()
        shutil.rmtree(path.parent, ignore_errors=True)  # the waiter may be quicker to write anew
    assert waited.wait(20)  # far more than the milliseconds that it takes; a hang fails
    assert held_together == [False]


def test_the_first_writer_wins_where_asked(tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    with atomic_writer(path, replace=False) as second:
        with atomic_writer(path, replace=False) as first:
            first.write(b"first")
        second.write(b"second")
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]


def test_leftovers_are_cleared_only_where_nobody_works(tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path)
    with folder.hold_shared_lock():
        leftover, young = tmp_path / "a.tar.1-00.part", tmp_path / "b.tar.1-00.part"
        for path in (leftover, young):
            path.write_bytes(b"")
        hours_ago = time.time() - 7200
        os.utime(leftover, (hours_ago, hours_ago))
        with folder.hold_shared_lock():
            assert leftover.exists()
    with folder.hold_shared_lock():
        assert leftover.exists(), "somebody has looked within the hour"
    os.utime(folder.staging / "cleaned", (hours_ago, hours_ago))
    with folder.hold_shared_lock():
        assert not leftover.exists()
        assert young.exists()  # of another machine, perhaps, that our locks do not reach


def test_what_may_pass_is_told_from_what_will_not_and_never_waited_for() -> None:
    """A scheduler tries the first kind again."""
    for number, passes, message in [
        (errno.ENOSPC, True, "a: the disk is full. What was finished is safe"),
        (errno.EDQUOT, True, "a: the disk is full"),
        (errno.EIO, True, "a: cannot write b"),
        (errno.EACCES, False, "a: cannot write b"),
    ]:
        with case(number):
            error = write_error(Path("a/b"), OSError(number, os.strerror(number)))
            assert isinstance(error, EnvironmentFailure) == passes
            assert str(error).startswith(message)
    # where /proc says of a folder that it does not exist, as a deleted one would, waiting ends
    with pytest.raises(TrilightError, match="/proc/nowhere"):
        hold_lock(Path("/proc/nowhere/lock")).__enter__()


@for_each("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EIO, errno.EINVAL])
def test_without_locks_everything_goes_on_after_one_warning(
    number: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.clear()
    refuse = mock.Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(file_locks, "_unlocked", itertools.count())
    folder, cache = DatasetFolder(tmp_path / "set"), ShardCache(tmp_path / "cache", 1 << 20)
    with folder.hold_shared_lock(), folder.mutex("manifest") as ours, folder.hold_exclusive_lock():
        with hold_lock(tmp_path / "a") as first, hold_lock(tmp_path / "a", wait=True) as second:
            assert ours and first and second and not is_locked(tmp_path / "a")
    with AssetStore(tmp_path / "store").lock("abc"):
        pass
    with claim_run(RunFolder(tmp_path / "run"), DistributedContext(device=torch.device("cpu"))):
        pass
    shard = tmp_path / "shard"
    shard.write_bytes(b"bytes")
    url = remote("http://127.0.0.1/a.tar")
    cache.keep(shard, url, "0" * 64)
    with cache.open(url, num_bytes=5, sha256="0" * 64) as stream:
        assert stream.read() == b"bytes"
    (warning,) = caplog.messages
    assert (
        f"/set/.staging/lock: the file system carries no locks ({os.strerror(number)})" in warning
    )


def test_one_function_takes_every_lock() -> None:
    packages = ("infra", "model", "pipeline", "scene_templates", "storage", "train", "trilight")
    files = [path for name in packages for path in (ROOT / name).rglob("*.py")]
    takers = [path for path in files if re.search(r"\b(flock|lockf|F_SETLKW?)\(", path.read_text())]
    assert takers == [ROOT / "storage" / "file_locks.py"]


def test_who_waits_says_for_whom_and_since_when(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, and again after ever longer times; of a thread of the same process never."""
    monkeypatch.setattr(file_locks, "_SILENT_S", 0.1)
    path = tmp_path / "a\x1b]0;b.claim"
    command = [sys.executable, "-c", HOLD.replace("sleep(60)", "sleep(1.5)"), str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as holder:
        assert holder.stdout is not None and holder.stdout.readline()
        assert is_locked(path)
        with hold_lock(path, wait=True):
            waiter = threading.Thread(target=lambda: hold_lock(path, wait=True).__enter__())
            waiter.start()
            said = len(caplog.messages)
            time.sleep(0.5)
        waiter.join(20)
    assert 2 <= said == len(caplog.messages) <= 4
    since = r"at it since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC"
    holding = f"process {holder.pid} of {re.escape(socket.gethostname())}, {since}"
    assert re.search(rf"a\\x1b\]0;b.claim: waiting for \d+ s for {holding}", caplog.messages[0])


def test_a_claim_that_says_nothing_readable_is_anothers(tmp_path: Path) -> None:
    cut_or_odd = ("", "x", "h 1", "h x 5", "h 1 9999999999999999999", "h 1 nan")
    for text in (*cut_or_odd, "\x1b[1m 1 5", "a b c d"):
        (tmp_path / "a").write_text(text)
        assert describe_holder(tmp_path / "a").isprintable(), text
    os.mkfifo(tmp_path / "fifo")
    for name in ("fifo", "none", "."):
        assert describe_holder(tmp_path / name) == "another process"


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
    whole = b'{"count": 1}\n{"count": 2}\n'
    for torn in (b"", b'{"cou', b"\xff\xff", b"\0\0\0"):
        rows = read_json_lines(whole + torn, Note, "log", torn_end=True)
        assert rows == [Note(count=1), Note(count=2)]
    with pytest.raises(TrilightError, match="log:3: all of it is not JSON"):
        read_json_lines(whole + b"\xff", Note, "log")
    for wrong in (b"\xff\n", b"\xff\n" + whole):
        with pytest.raises(TrilightError, match="log:3: "):
            read_json_lines(whole + wrong, Note, "log", torn_end=True)


def test_a_stream_is_hashed_from_where_it_stands() -> None:
    stream = io.BytesIO(b"header and rest")
    stream.seek(7)
    assert sha256_of_stream(stream) == sha256_hex(b"and rest")
    assert stream.read() == b""
