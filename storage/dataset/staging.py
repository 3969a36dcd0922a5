"""Finished scenes that wait for their shard, each in one file that appears whole.

A staged file is a small tar with the members of the sample and, as `failures`, the attempts that
were rejected on the way. A scene that no attempt could save has failures only.
"""

import io
from pathlib import Path

from storage.atomic import write_atomically
from storage.dataset.layout import numbered_path
from storage.dataset.shard import open_shard, write_tar
from storage.records.objects import Failure, decode_failures, encode_failures
from storage.records.sample import sample_key

_FAILURES = "failures"


def stage_members(
    folder: Path, scene_index: int, members: dict[str, bytes], failures: list[Failure]
) -> None:
    """Write what became of a scene into the staging folder of its shard.

    The members of its sample are packed as they will stay; there are none where it was given up.
    """
    stream = io.BytesIO()
    write_tar(
        stream, [(sample_key(scene_index), {**members, _FAILURES: encode_failures(failures)})]
    )
    write_atomically(_path(folder, scene_index), stream.getvalue())


def is_staged(folder: Path, scene_index: int) -> bool:
    """Return whether a scene is finished."""
    return _path(folder, scene_index).exists()


def read_staged_scene(folder: Path, scene_index: int) -> tuple[dict[str, bytes], list[Failure]]:
    """Return the members of a finished scene's sample, none where it was given up, and failures.

    Raises:
        ShardMissing: it is not staged.
    """
    with open_shard(_path(folder, scene_index)) as opened:
        ((_, members),) = opened
    failures = decode_failures(members.pop(_FAILURES))
    return members, failures


def _path(folder: Path, scene_index: int) -> Path:
    return folder / numbered_path(scene_index, f"{sample_key(scene_index)}.tar")
