"""Which dataset the meshes of `trilight assets` suffice for, as a command that runs."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.builds.named import BUILDS, named_build
from storage.dataset.splits import shards_for, split_of_object, split_of_shard

_BUILD = "smoke"


def generate_from_meshes(
    geometry_sha256: Sequence[str],
    folder: Path,
    allow_licences: Sequence[str],
    *,
    own_materials: bool = False,
) -> list[str]:
    """Return the words of a `generate` for which there are objects in every split that it needs.

    With few objects a split may be empty: then as many scenes as come before it is needed, or if
    no object is for training, all for testing.

    Args:
        geometry_sha256: digests of the meshes, by which objects are dealt to splits.
        folder: where they are.
        allow_licences: those that were allowed beside the usual ones.
        own_materials: whether meshes keep their own.
    """
    splits = named_build(_BUILD).splits
    there = {split_of_object(digest, splits) for digest in geometry_sha256}
    words = ["generate", _BUILD, "--objects", str(folder), "--out", f"{folder}-{_BUILD}"]
    shards = shards_for(BUILDS[_BUILD].num_scenes, splits)
    enough = next((i for i in range(shards) if split_of_shard(i, splits) not in there), shards)
    if own_materials:
        words += ["--set", "scenes.materials.source=object"]
    if enough == 0:
        words += ["--set", "splits.one_split=true"]
    elif enough < shards:
        words += ["--scenes", str(enough * splits.scenes_per_shard)]
    return [*words, *(word for name in allow_licences for word in ("--allow-licences", name))]
