"""Table of the export formats, and the export of a dataset to one of them."""

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from pipeline.exchange.exports.coco import write_coco
from pipeline.exchange.exports.energon import write_energon
from pipeline.exchange.exports.hypersim import write_hypersim
from pipeline.exchange.exports.pictures import write_huggingface, write_nerfstudio
from pipeline.exchange.exports.scenes import SCENE_FORMS, write_benchmark, write_scenes
from pipeline.exchange.select_samples import select_samples
from storage.atomic import write_atomically
from storage.dataset.dataset import open_dataset
from storage.errors import TrilightError
from storage.records.sample import Sample

ExportForm = Literal[
    "nerfstudio",
    "coco",
    "huggingface",
    "hypersim",
    "energon",
    "h5",
    "json",
    "usd",
    "exr",
    "benchmark",
]

FORMS: dict[str, Callable[[Iterator[tuple[str, Sample]], Path], Sequence[str] | None]] = {
    "nerfstudio": write_nerfstudio,
    "coco": write_coco,
    "huggingface": write_huggingface,
    "hypersim": write_hypersim,
    **{form: functools.partial(write_scenes, form=form) for form in SCENE_FORMS},
    "benchmark": write_benchmark,
}
"""Writers by format. Each writes into a folder, index files last, and may return sentences about
losses."""

_RIGHTS = ("LICENSE.md", "attribution.csv")
"""Files of a dataset on rights, which every export contains."""


def export_dataset(
    source: str,
    form: ExportForm,
    out: Path,
    *,
    split: str | None,
    scene: str | None,
    done: Callable[[int], None],
) -> Sequence[str]:
    """Write samples of a dataset in a format of FORMS, with the rights of its objects.

    `out` is empty or does not exist; `split` and `scene` are those of `select_samples`. `done` is
    called after each sample with its number of views. The returned sentences tell what the format
    cannot hold.

    Raises:
        TrilightError: the dataset is unusable, there is no such split or scene, or the folder is
            not empty or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(f"--out is {out}, which is not empty; expected a new folder.")
    dataset = open_dataset(source)

    def samples() -> Iterator[tuple[str, Sample]]:
        for split_sample in select_samples(dataset, split=split, scene=scene):
            yield split_sample
            done(split_sample[1].scene.num_views)

    lost: Sequence[str] | None = None
    if form == "energon":  # takes the shards as they are
        if scene is not None:
            raise TrilightError(
                "--form energon copies whole shards, and --scene names a sample; leave it out, or "
                "make a dataset of it first (`trilight shards select`)."
            )
        write_energon(dataset, out, split, done)
    else:
        lost = FORMS[form](samples(), out)
    for name in _RIGHTS:
        if (data := dataset.store.get(name)) is not None:
            write_atomically(out / name, data)
    return lost or ()
