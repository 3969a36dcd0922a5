"""`UnfinishedShard`: the missing, claimed and staged scenes of a shard that several workers make.

A finished scene waits in the staging folder until all scenes of its shard are there. A claim
(storage.file_locks) marks a scene that a worker is making, or a shard that it is packing; it ends
with the process that holds it, so that nothing has to be cleaned up after a kill.
"""

import contextlib
import logging
import time
from collections.abc import Iterator
from pathlib import Path

from pipeline.shards.pack import pack_shard
from storage.dataset.layout import DatasetFolder, numbered_path
from storage.dataset.manifest import ShardEntry, read_head
from storage.dataset.progress import count_given_up
from storage.dataset.scene_logs import log_scene
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, split_of_shard
from storage.dataset.staging import is_staged, stage_scene
from storage.file_locks import hold_lock, is_locked
from storage.records.objects import Failure
from storage.records.profiles import Profile
from storage.records.sample import Sample, sample_key

log = logging.getLogger("trilight.scenes")


class UnfinishedShard:
    """One shard of a dataset, finished or not."""

    def __init__(self, folder: DatasetFolder, splits: SplitSettings, shard_index: int) -> None:
        self.name = shard_name(shard_index, splits)
        self.split = split_of_shard(shard_index, splits)
        self._folder = folder
        self._index = shard_index
        self._splits = splits
        self._staged = folder.staged_shard(self.name)
        self._packing = self._staged / "pack.claim"

    @contextlib.contextmanager
    def claim(self, scene_index: int) -> Iterator[bool]:
        """Claim a scene; yield True if it is missing and no other worker has claimed it.

        Raises:
            TrilightError: the folder cannot be written.
        """
        if self._is_done(scene_index):
            yield False
            return
        with hold_lock(self._claim(scene_index)) as ours:
            yield ours and not self._is_done(scene_index)  # finished meanwhile

    def stage(
        self,
        scene_index: int,
        sample: Sample | None,
        failures: list[Failure],
        profile: Profile,
        *,
        began: float,
        cores: int,
    ) -> None:
        """Stage a finished or given-up scene as `stage_scene`, and log its cost.

        Args:
            scene_index: index of the scene.
            sample: the finished scene; None if it was given up.
            failures: rejections of the scene's attempts.
            profile: how arrays and pictures are packed.
            began: start of the work on it, by `time.monotonic`.
            cores: number of cores that the work kept busy.
        """
        stage_scene(self._staged, scene_index, sample, failures, profile)
        seconds = time.monotonic() - began
        outcome = "made" if sample else "given up"
        log.info("%s: scene %09d %s in %.1f s", self.name, scene_index, outcome, seconds)
        folder = self._folder
        count = len(failures)
        if sample is None:
            count_given_up(folder, scene_index)
        log_scene(folder, self.name, scene_index, seconds=seconds, cores=cores, num_rejected=count)

    def pack(self) -> ShardEntry | None:
        """Pack the shard if all its scenes are staged, unless another worker does.

        Returns:
            The shard if this call packed it, else None.
        """
        scenes, grows = self._plan()
        if self._is_packed() or not all(is_staged(self._staged, index) for index in scenes):
            return None
        with contextlib.ExitStack() as stack:
            if not stack.enter_context(hold_lock(self._packing)):
                return None
            if grows or scenes != scenes_of_shard(self._index, self._splits):
                stack.enter_context(self._folder.mutex("manifest"))  # no plan changes meanwhile
            if self._is_packed() or self._plan() != (scenes, grows):
                return None
            shard = pack_shard(self._folder, self.name, scenes, grows=grows)
        log.info("%s: packed, %d scenes, %d bytes", self.name, shard.num_samples, shard.num_bytes)
        return shard

    def is_free(self) -> bool:
        """Return True if a missing scene, or the packing, is claimed by no worker.

        The check claims each missing scene for a moment. A worker that wants the scene just then
        skips it, so a caller that gets True must make it.
        """
        claims = self.missing_claims()
        if self._is_packed():  # checked last: packing empties the staging folder
            return False
        return not all(map(is_locked, claims))

    def missing_claims(self) -> list[Path]:
        """Return the claim files of the missing scenes; without any, the one of the packing."""
        missing = [index for index in self._plan()[0] if not is_staged(self._staged, index)]
        return [*map(self._claim, missing)] or [self._packing]

    def _claim(self, scene_index: int) -> Path:
        return self._staged / numbered_path(scene_index, f"{sample_key(scene_index)}.claim")

    def _is_done(self, scene_index: int) -> bool:
        return is_staged(self._staged, scene_index) or self._is_packed()

    def _is_packed(self) -> bool:
        is_sent = self._folder.is_sent(self.name)
        return is_sent or (self._folder.shard(self.name).exists() and not self._plan()[1])

    def _plan(self) -> tuple[range, bool]:
        """Return the planned scenes, and whether a shard with fewer scenes is to grow."""
        head = read_head(self._folder.manifest)
        scenes = scenes_of_shard(self._index, cut_splits(head.num_scenes, self._splits))
        return scenes, self.name in head.growing
