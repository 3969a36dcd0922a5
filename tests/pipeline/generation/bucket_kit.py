"""A bucket on a real S3 server, and machines that make a dataset of tiny scenes in it."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.generation import dataset_writer
from pipeline.generation.dataset_writer import DatasetWriter, begin_or_resume_dataset
from pipeline.presets.registry import preset_settings
from pipeline.shards.pack_shards import PublishedShards, pack_shard
from storage.dataset.layout import dataset_folder
from storage.records.objects import Failure
from storage.records.sample import sample_key
from storage.remote import store, transfers
from storage.remote import url as remote_url
from tests.pipeline.generation.test_dataset_writer import ENVIRONMENT, _build, _sample
from tests.s3_server import CREDENTIALS, control
from tests.scenes_by_hand import stage_scene

OUT = "s3://shards/set"


@contextlib.contextmanager
def empty_bucket(
    port: int, monkeypatch: pytest.MonkeyPatch, *, keep_driver: bool = False
) -> Iterator[Any]:
    """Give the driver of an empty server with a bucket `shards`, which the environment names.

    Args:
        port: of the server.
        monkeypatch: takes the environment back.
        keep_driver: whether the driver of the test before is used, which costs less than a new one.
    """
    for name, value in {**CREDENTIALS, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(transfers, "PAUSE_S", 0.0)
    monkeypatch.setattr(dataset_writer, "_PATIENCE_S", 0.0)
    control(port, "reset")
    if not keep_driver:
        remote_url._driver_of.cache_clear()
    place = remote_url.parse_url("s3://shards", what="bucket")
    assert isinstance(place, remote_url.RemoteUrl)
    driver = remote_url._driver_of(place, os.getpid())
    driver.invalidate_cache()
    driver.mkdir("shards")
    yield driver
    if not keep_driver:
        remote_url._driver_of.cache_clear()


class Killed(BaseException):
    """Ends a maker between two requests, as SIGKILL would: locks go with it, and nothing else."""


class Writes:
    """The writes of all makers to buckets, of which a run has so many before it is killed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = 0
        put = store.RemoteStore._upload

        def put_or_die(bucket: Any, *arguments: Any, **options: Any) -> None:
            self.left -= 1
            if self.left < 0:
                raise Killed
            put(bucket, *arguments, **options)

        monkeypatch.setattr(store.RemoteStore, "_upload", put_or_die)


class Machines:
    """Makers with a cache each: nothing joins them but the bucket."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._tmp_path = tmp_path
        self._monkeypatch = monkeypatch

    def use(self, name: str) -> None:
        """Be this machine from now on."""
        self._monkeypatch.setenv("TRILIGHT_CACHE", str(self._tmp_path / name))

    @contextlib.contextmanager
    def maker(self, name: str, scenes: int = 8, **changes: Any) -> Iterator[DatasetWriter]:
        """Take part from a machine, as a run does."""
        self.use(name)
        shards = PublishedShards(dataset_folder(OUT))
        build = preset_settings("smoke", changes=changes) if changes else _build()
        with shards.hold_lock():
            yield begin_or_resume_dataset(shards, build, ENVIRONMENT, scenes)


def other_shard(writer: DatasetWriter) -> Any:
    """Pack a first shard of other bytes, as another processor may, with rejections of its own."""
    for index in range(4):
        sample = dataclasses.replace(_sample(9 + index), key=sample_key(index))
        failure = Failure(stage="renders", item=sample_key(index), reason="other", message="y")
        staged = writer.folder.staged_shard("train-000000.tar")
        stage_scene(staged, index, sample, [failure], "lossless")
    return pack_shard(writer.folder, "train-000000.tar", range(4))
