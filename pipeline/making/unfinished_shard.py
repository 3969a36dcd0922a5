"""A shard in the making, shared by all who make it: which scenes are missing, claimed or staged.

A finished scene waits in the staging folder until all scenes of its shard are there. A claim
(storage.claims) says that somebody is at work on a scene, or packs the shard; it ends with
the process that holds it, so that nothing has to be cleaned up after a kill.
"""

import contextlib
import logging
import time
from collections.abc import Iterator
from pathlib import Path

from pipeline.shards.pack import pack_shard
from storage.claims import claimed, is_claimed
from storage.dataset.layout import DatasetFolder, numbered
from storage.dataset.manifest import ShardEntry, read_head
from storage.dataset.progress import count_given_up
from storage.dataset.scene_logs import log_scene
from storage.dataset.settings import SplitSettings
from storage.dataset.splits import cut_splits, scenes_of_shard, shard_name, split_of_shard
from storage.dataset.staging import is_staged, stage_scene
from storage.records.objects import Failure
from storage.records.profiles import Profile
from storage.records.sample import Sample, sample_key

log = logging.getLogger("trilight.scenes")


class UnfinishedShard:
    """One shard of a dataset, finished or not."""

    def __init__(self, folder: DatasetFolder, splits: SplitSettings, shard_index: int) -> None:
        self.name = shard_name(shard_index, splits)
        self.split = split_of_shard(shard_index, splits)
        self._folder, self._index, self._splits = folder, shard_index, splits
        self._staged = folder.staged_shard(self.name)
        self._packing = self._staged / "pack.claim"

    @contextlib.contextmanager
    def claim(self, scene_index: int) -> Iterator[bool]:
        """Say whether the scene is ours to make: it is missing, and nobody else is at it.

        Raises:
            TrilightError: the folder cannot be written.
        """
        if self._is_done(scene_index):
            yield False
            return
        with claimed(self._claim(scene_index)) as ours:
            yield ours and not self._is_done(scene_index)  # somebody may have made it meanwhile

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
        """Keep a finished scene, or that it was given up, and log what it took; as `stage_scene`.

        Work on it `began` at that time, by `time.monotonic`, and kept so many `cores` busy.
        """
        stage_scene(self._staged, scene_index, sample, failures, profile)
        seconds, outcome = time.monotonic() - began, "made" if sample else "given up"
        log.info("%s: scene %09d %s in %.1f s", self.name, scene_index, outcome, seconds)
        folder, count = self._folder, len(failures)
        if sample is None:
            count_given_up(folder, scene_index)
        log_scene(folder, self.name, scene_index, seconds=seconds, cores=cores, num_rejected=count)

    def pack(self) -> ShardEntry | None:
        """Pack the shard if all its scenes are staged, unless somebody else does.

        Returns:
            The shard, where this call packed it.
        """
        scenes, grows = self._plan()
        if self._is_packed() or not all(is_staged(self._staged, index) for index in scenes):
            return None
        with contextlib.ExitStack() as stack:
            if not stack.enter_context(claimed(self._packing)):
                return None
            if grows or scenes != scenes_of_shard(self._index, self._splits):
                stack.enter_context(self._folder.turn("manifest"))  # the plan stays for so long
            if self._is_packed() or self._plan() != (scenes, grows):
                return None
            shard = pack_shard(self._folder, self.name, scenes, grows=grows)
        log.info("%s: packed, %d scenes, %d bytes", self.name, shard.num_samples, shard.num_bytes)
        return shard

    def is_free(self) -> bool:
        """Return whether something of the shard is missing that nobody is at: a scene, or packing.

        This look claims each missing scene for a moment. Whoever wants that scene just then leaves
        it to us, so a caller that gets True must go and make it.
        """
        claims = self.wanted_claims()
        if self._is_packed():  # looked at last: packing empties the staging folder
            return False
        return not all(map(is_claimed, claims))

    def wanted_claims(self) -> list[Path]:
        """Return the claims on what the shard lacks: its missing scenes, or else its packing."""
        missing = [index for index in self._plan()[0] if not is_staged(self._staged, index)]
        return [*map(self._claim, missing)] or [self._packing]

    def _claim(self, scene_index: int) -> Path:
        return self._staged / numbered(scene_index, f"{sample_key(scene_index)}.claim")

    def _is_done(self, scene_index: int) -> bool:
        return is_staged(self._staged, scene_index) or self._is_packed()

    def _is_packed(self) -> bool:
        is_sent = self._folder.is_sent(self.name)
        return is_sent or (self._folder.shard(self.name).exists() and not self._plan()[1])

    def _plan(self) -> tuple[range, bool]:
        """Return the scenes that are planned now, and whether a shard of fewer is to grow."""
        head = read_head(self._folder.manifest)
        scenes = scenes_of_shard(self._index, cut_splits(head.num_scenes, self._splits))
        return scenes, self.name in head.growing
