"""Datasets as large as one likes, for what reads or extends them: everything real but the pictures.

An outline has shards of which only the size is there (holes in the file system), with head, notes,
lock and logs of the full size: eight scenes a shard, four views each, so that 250,000 shards stand
for two million scenes. All but the last shard are made. A small set has whole shards of one scene
each, all of the same pictures, under keys of their own.
"""

import hashlib
import io
import json
import os
from pathlib import Path

from infra.bench.subjects.stand_in import RESOLUTION, stand_in_members, stand_in_objects
from pipeline.builds.settings import BuildSettings
from pipeline.builds.training import smoke
from pipeline.making.environment import environment
from pipeline.renders.variant import choose_variant
from storage.conventions import SPLITS
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, ShardEntry, write_manifest
from storage.dataset.scene_logs import log_name
from storage.dataset.shard import scan_members, write_tar
from storage.dataset.shard_notes import ShardNote, encode_note, note_of
from storage.dataset.splits import shard_name, split_of_shard
from storage.digests import sha256_hex
from storage.records.objects import encode_objects_lock, write_failures, write_objects_lock
from storage.records.sample import sample_key
from storage.settings.changes import changed

SCENES_OF_OUTLINE, SCENES_OF_WHOLE = 8, 1
"""Scenes of a shard."""
_KEY = slice(0, 9)
_SUM = slice(148, 154)
"""Where a tar's header has the key of a member, and the digits of its own sum."""
_BLOCK = 512


def simulated_build(scenes_per_shard: int) -> BuildSettings:
    """Return the settings of such a dataset."""
    changes = {"splits.scenes_per_shard": scenes_per_shard, "renders.resolution": RESOLUTION}
    return changed(smoke(), changes)


class ShardTemplate:
    """A shard whose bytes are written once and then given other keys."""

    def __init__(self, split: str, num_scenes: int, *, first: int) -> None:
        """Pack `num_scenes` scenes from stand-in number `first` on."""
        packed = io.BytesIO()
        members = [stand_in_members(first + row, split=split) for row in range(num_scenes)]
        write_tar(packed, [(sample_key(row), each) for row, each in enumerate(members)])
        self._data = packed.getvalue()
        self._members = list(scan_members(packed, split))
        self.num_bytes = len(self._data)

    def stamped(self, first_scene: int) -> bytes:
        """Return the bytes of the shard that begins with a scene: as if it were packed."""
        data = bytearray(self._data)
        for member in self._members:
            header = memoryview(data)[member.offset - _BLOCK : member.offset]
            key = sample_key(first_scene + int(member.key)).encode()
            total = int(bytes(header[_SUM]), 8) + sum(key) - sum(header[_KEY])
            header[_KEY], header[_SUM] = key, b"%06o" % total
        return bytes(data)


def write_outline(root: Path, num_shards: int, *, made: int | None = None) -> None:
    """Write a dataset of holes, whose last shard is still to make, or all but the first `made`."""
    made = num_shards - 1 if made is None else made
    build = simulated_build(SCENES_OF_OUTLINE)
    template = ShardTemplate("train", SCENES_OF_OUTLINE, first=0)
    folder = DatasetFolder(root)
    entries = [outlined(index, build, template) for index in range(made)]
    for index, entry in enumerate(entries):
        path, log = folder.shard(entry.name), root / log_name(entry.name)
        note = note_of(folder, entry.name)
        for place in (path, log, note):
            place.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.truncate(path, entry.num_bytes)
        log.write_text(_log(index * SCENES_OF_OUTLINE))
        note.write_bytes(encode_note(ShardNote(shard=entry, failures=())))
    _finish(folder, build, [], num_shards)


def write_whole(root: Path, num_shards: int, *, first: int = 0) -> None:
    """Write a finished dataset of whole shards; another `first` has scenes that differ."""
    build = simulated_build(SCENES_OF_WHOLE)
    templates = {split: ShardTemplate(split, SCENES_OF_WHOLE, first=first) for split in SPLITS}
    folder = DatasetFolder(root)
    entries = []
    for index in range(num_shards):
        name, split = shard_name(index, build.splits), split_of_shard(index, build.splits)
        scene = index * SCENES_OF_WHOLE
        data = templates[split].stamped(scene)
        folder.shard(name).parent.mkdir(parents=True, exist_ok=True)
        folder.shard(name).write_bytes(data)
        entries.append(
            ShardEntry(
                name=name,
                split=split,
                num_samples=SCENES_OF_WHOLE,
                num_bytes=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
            )
        )
    _finish(folder, build, entries, num_shards)
    folder.card.write_text("A simulated dataset.\n")


def outlined(index: int, build: BuildSettings, template: ShardTemplate) -> ShardEntry:
    """Return the entry of a shard of an outline."""
    return ShardEntry(
        name=shard_name(index, build.splits),
        split=split_of_shard(index, build.splits),
        num_samples=SCENES_OF_OUTLINE,
        num_bytes=template.num_bytes,
        sha256=f"{index:064x}",
    )


def _finish(
    folder: DatasetFolder, build: BuildSettings, entries: list[ShardEntry], num_shards: int
) -> None:
    lock = stand_in_objects()
    write_objects_lock(folder.objects_lock, lock)
    write_failures(folder.failures, [])
    manifest = Manifest(
        build=build.build,
        settings=build.as_json(),
        environment=environment(choose_variant()),
        num_scenes=num_shards * build.splits.scenes_per_shard,
        num_views=build.scenes.num_views,
        objects_lock_sha256=sha256_hex(encode_objects_lock(lock)),
        shards=tuple(entries),
    )
    write_manifest(folder.manifest, manifest)


def _log(first_scene: int) -> str:
    rows = (
        {
            "scene": sample_key(scene), "seconds": 12.5, "cores": 2, "rejected_attempts": 0,
            "host": "stand-in", "pid": 1, "finished_unix_s": 1.76e9 + 12.5 * scene,
        }
        for scene in range(first_scene, first_scene + SCENES_OF_OUTLINE)
    )  # fmt: skip
    return "".join(f"{json.dumps(row)}\n" for row in rows)
