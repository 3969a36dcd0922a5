"""The `generate` command for which the meshes of `trilight assets` suffice."""

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
    """Return the words of a `generate` command whose splits all have objects.

    With few objects a split may be empty: then the command makes only the scenes before the first
    one that needs it, or if no object is for training, all scenes for testing.

    Args:
        geometry_sha256: digests of the meshes, by which objects are assigned to splits.
        folder: folder of the meshes.
        allow_licences: licences that were allowed in addition to the usual ones.
        own_materials: whether meshes keep the materials of their source.
    """
    splits = named_build(_BUILD).splits
    present = {split_of_object(digest, splits) for digest in geometry_sha256}
    words = ["generate", _BUILD, "--objects", str(folder), "--out", f"{folder}-{_BUILD}"]
    shards = shards_for(BUILDS[_BUILD].num_scenes, splits)
    usable = next((i for i in range(shards) if split_of_shard(i, splits) not in present), shards)
    if own_materials:
        words += ["--set", "scenes.materials.source=object"]
    if usable == 0:
        words += ["--set", "splits.one_split=true"]
    elif usable < shards:
        words += ["--scenes", str(usable * splits.scenes_per_shard)]
    return [*words, *(word for name in allow_licences for word in ("--allow-licences", name))]
