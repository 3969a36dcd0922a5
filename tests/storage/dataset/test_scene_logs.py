"""Logs of scenes: of many, few are read, and they say the same."""

import json
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.dataset import scene_logs
from storage.dataset.layout import DatasetFolder
from storage.dataset.scene_logs import SceneLog, look_at_logs


def _write(folder: DatasetFolder, number: int, *, end_s: float) -> None:
    """Write a log of two scenes of 10 s on two cores, and of a row that a kill has cut."""
    path = folder.logs / f"part-{number // 8:04d}" / f"train-{number:06d}.tar.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [{"seconds": 10.0, "cores": 2, "finished_unix_s": end_s + at} for at in (0.0, 5.0)]
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"seconds": 1')
    os.utime(path, (end_s + 5.0, end_s + 5.0))


def test_of_many_logs_few_are_read_and_the_last_scenes_are_all_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = DatasetFolder(tmp_path)
    assert look_at_logs(folder).core_s is None
    ends_s = [1000.0 + 7.0 * ((5 * number) % 24) for number in range(24)]  # in no order
    for number, end_s in enumerate(ends_s):
        _write(folder, number, end_s=end_s)
    (folder.logs / "asked.json").write_text("[]")
    every = look_at_logs(folder)
    assert every.core_s == 24 * 2 * 10 * 2 and len(every.last) == 48
    read, decode = Counter[str](), scene_logs.decode_scene_log

    def counted(text: str) -> Iterator[SceneLog]:
        read["logs"] += 1
        return decode(text)

    monkeypatch.setattr(scene_logs, "decode_scene_log", counted)
    monkeypatch.setattr(scene_logs, "LAST_SCENES", 5)
    monkeypatch.setattr(scene_logs, "MOST_LOGS", 6)
    some = look_at_logs(folder)
    assert read["logs"] == 5 + 6 and some.core_s == every.core_s
    assert some.last == every.last[-5:]
