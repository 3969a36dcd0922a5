"""Pipes, devices and folders under the names of our files: a sentence, at once."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from infra.judging import _bytes_of
from model.weights import read_metadata, read_tensors
from pipeline.objects.local.folder import file_text
from storage.dataset.manifest import index_shard, read_head, read_manifest
from storage.errors import TrilightError
from storage.records.objects import read_failures, read_objects_lock
from storage.records.scene_file import read_scene_file
from tests.for_each import case
from train.folder import read_rows
from train.loop.checkpoints import read_checkpoint

READERS: list[Callable[[Path], object]] = [
    *(_bytes_of, file_text, index_shard, read_checkpoint, read_failures, read_head),
    *(read_manifest, read_metadata, read_objects_lock, read_rows, read_scene_file, read_tensors),
]


def _others(folder: Path) -> Iterator[Path]:
    os.mkfifo(folder / "train-000000.safetensors")
    yield folder / "train-000000.safetensors"
    (folder / "train-000001.safetensors").symlink_to("/dev/zero")
    yield folder / "train-000001.safetensors"
    (folder / "train-000002.safetensors").mkdir()
    yield folder / "train-000002.safetensors"


def test_what_is_no_plain_file_is_refused_at_once(tmp_path: Path) -> None:
    for path in _others(tmp_path):
        for read in READERS:
            with case((read.__name__, path.name)):
                signal.alarm(10)  # a pipe would be waited for without end
                with pytest.raises((TrilightError, OSError), match="plain file|regular file"):
                    read(path)
                signal.alarm(0)
