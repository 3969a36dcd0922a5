"""Claims: one holder at a time, free again when the holder ends, and the first writer wins."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from storage.atomic import atomic_writer, write_error
from storage.claims import claimed
from storage.dataset.layout import DatasetFolder
from storage.errors import EnvironmentFailure, TrilightError
from tests.conftest import ROOT
from tests.for_each import for_each

HOLD = """
import sys, time
from pathlib import Path
from storage.claims import claimed
with claimed(Path(sys.argv[1])) as ours:
    print(ours, flush=True)
    time.sleep(60)
"""


def test_a_claim_has_one_holder(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "a.claim"
    with claimed(path) as first, claimed(path) as second:
        assert first
        assert not second
    with claimed(path) as third:
        assert third


def test_a_claim_ends_with_its_process(tmp_path: Path) -> None:
    path = tmp_path / "a.claim"
    command = [sys.executable, "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        with claimed(path) as ours:
            assert not ours
        holder.send_signal(signal.SIGKILL)
    with claimed(path, wait=True) as ours:
        assert ours


def test_a_claim_that_its_holder_deleted_is_not_shared(tmp_path: Path) -> None:
    """Who waited for the old file must not hold it while another holds a new one of that name."""
    path, waited = tmp_path / "samples" / "a.claim", threading.Event()
    held_together: list[bool] = []

    def wait() -> None:
        with claimed(path, wait=True), claimed(path) as again:
            held_together.append(again)
        waited.set()

    with claimed(path):
        waiter = threading.Thread(target=wait)
        waiter.start()
        shutil.rmtree(path.parent)
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
    with folder.joined():
        leftover, young = tmp_path / "a.tar.1-00.part", tmp_path / "b.tar.1-00.part"
        for path in (leftover, young):
            path.write_bytes(b"")
        hours_ago = time.time() - 7200
        os.utime(leftover, (hours_ago, hours_ago))
        with folder.joined():
            assert leftover.exists()
    with folder.joined():
        assert leftover.exists(), "somebody has looked within the hour"
    os.utime(folder.staging / "cleaned", (hours_ago, hours_ago))
    with folder.joined():
        assert not leftover.exists()
        assert young.exists()  # of another machine, perhaps, that our locks do not reach


@for_each(
    ("number", "passes", "message"),
    [
        (errno.ENOSPC, True, "a: the disk is full. What was finished is safe"),
        (errno.EDQUOT, True, "a: the disk is full"),
        (errno.EIO, True, "a: cannot write b"),
        (errno.EACCES, False, "a: cannot write b"),
    ],
)
def test_what_may_pass_is_told_from_what_will_not(number: int, passes: bool, message: str) -> None:
    """A scheduler tries the first kind again."""
    error = write_error(Path("a/b"), OSError(number, os.strerror(number)))
    assert isinstance(error, EnvironmentFailure) == passes
    assert str(error).startswith(message)


def test_a_folder_that_can_never_be_made_is_said_at_once() -> None:
    """Where /proc says of a folder that it does not exist, as a deleted one would, waiting ends."""
    with pytest.raises(TrilightError, match="/proc/nowhere"), claimed(Path("/proc/nowhere/lock")):
        pass
