"""The soak: tenths are cut by when scenes were finished, and each sees its own looks."""

import os
import subprocess
from pathlib import Path

import pytest

from infra.bench import soak
from storage.layout import DatasetFolder


def test_tenths_follow_the_clock_and_hold_their_own_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = DatasetFolder(tmp_path)
    folder.logs.mkdir()
    # two shards made in turns: the logs are in another order than the scenes were finished in
    for shard in (0, 1):
        rows = [
            f'{{"seconds": {0.1 * (1 + at // 10)}, "finished_unix_s": {1000 + at}}}\n'
            for at in range(shard, 40, 2)
        ]
        (folder.logs / f"train-{shard:06d}.tar.jsonl").write_text("".join(rows))
    looks = [
        soak._Look(unix_s=1000 + at, megabytes=100 + at, open_files=at, processes=2)
        for at in range(40)
    ]
    parts = soak._parts(folder, looks)
    assert len(parts) == soak.PARTS
    assert [part.seconds_a_scene for part in parts][::3] == pytest.approx([0.1, 0.2, 0.3, 0.4])
    # four looks each, and one of the second after it
    assert [part.megabytes for part in parts] == [min(104 + 4 * at, 139) for at in range(10)]


def test_a_session_is_found_and_its_end_too() -> None:
    process = subprocess.Popen(["sleep", "60"], start_new_session=True)
    found = list(soak._of_session(process.pid))
    assert [path.name for path in found] == [str(process.pid)]
    look = soak._look(process.pid)
    assert look.processes == 1 and look.megabytes > 0 and look.open_files >= 3
    process.kill()
    process.wait()
    assert list(soak._of_session(process.pid)) == []
    assert os.getpid() not in [int(path.name) for path in found]
