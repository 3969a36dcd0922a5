"""Selects samples of a dataset by split and by key."""

from collections.abc import Iterator

from storage.conventions import SPLITS
from storage.dataset.dataset import Dataset
from storage.errors import TrilightError
from storage.records.sample import Sample, sample_key


def select_samples(
    dataset: Dataset, *, split: str | None = None, scene: str | None = None
) -> Iterator[tuple[str, Sample]]:
    """Yield (split, sample) of a dataset in its order, with pictures.

    `split` and `scene` choose one; the key of a scene may lack the zeros before it.

    Raises:
        TrilightError: the split or scene does not exist, or the dataset is empty or damaged.
    """
    if split is not None and split not in SPLITS:
        raise TrilightError(f"split is {split!r}; expected one of {', '.join(SPLITS)}.")
    scene_key = sample_key(int(scene)) if scene is not None and scene.isdecimal() else scene
    has_samples = False
    for shard in dataset.manifest.shards:
        if split not in (None, shard.split):
            continue
        keys = [key for key in dataset.keys(shard) if scene_key in (None, key)]
        has_samples = has_samples or bool(keys)
        for sample in dataset.read_samples(shard, keys):
            yield shard.split, sample
    if not has_samples:
        which = f"scene {scene_key}" if scene_key else "scene"
        where = "" if split is None else f" in split {split}"
        raise TrilightError(
            f"{dataset.display_name}: no {which}{where}; expected one of its "
            f"{dataset.manifest.num_samples}. List them with `trilight inspect`."
        )
