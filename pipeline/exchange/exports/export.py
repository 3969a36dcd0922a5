"""Which exports there are, and how the samples of a dataset go through one."""

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from pipeline.exchange.select_samples import select_samples
from pipeline.exchange.exports.coco import write_coco
from pipeline.exchange.exports.huggingface import write_huggingface
from pipeline.exchange.exports.hypersim import write_hypersim
from pipeline.exchange.exports.nerfstudio import write_nerfstudio
from pipeline.exchange.exports.scenes import WRITERS, write_benchmark, write_scenes
from storage.atomic import write_atomically
from storage.dataset.dataset import open_dataset
from storage.errors import TrilightError
from storage.records.sample import Sample

ExportForm = Literal[
    "nerfstudio", "coco", "huggingface", "hypersim", "h5", "json", "usd", "exr", "benchmark"
]

Samples = Iterator[tuple[str, Sample]]
"""Samples with the split of each."""

FORMS: dict[str, Callable[[Samples, Path], Sequence[str] | None]] = {
    "nerfstudio": write_nerfstudio,
    "coco": write_coco,
    "huggingface": write_huggingface,
    "hypersim": write_hypersim,
    **{form: functools.partial(write_scenes, form=form) for form in WRITERS},
    "benchmark": write_benchmark,
}
"""Writers by form; each writes into a folder, the file that names all others last, and returns what
it could not carry over, where that can happen."""

_RIGHTS = ("LICENSE.md", "attribution.csv")
"""Files of a dataset that go with every copy of its objects' pictures."""


def export_dataset(
    source: str,
    form: ExportForm,
    out: Path,
    *,
    split: str | None,
    scene: str | None,
    done: Callable[[Sample], None],
) -> Sequence[str]:
    """Write samples of a dataset in another library's form, with the rights of its objects.

    Args:
        source: a dataset, its folder or URL.
        form: a name of FORMS.
        out: a folder that is empty, or does not exist.
        split, scene: as `chosen_samples`.
        done: called with each sample that is read.

    Returns:
        What the form cannot hold, for people.

    Raises:
        TrilightError: the dataset is unusable, there is no such split or scene, or the folder is
            not empty or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(f"--out is {out}, which is not empty; expected a new folder.")
    dataset = open_dataset(source)

    def samples() -> Samples:
        for split_sample in select_samples(dataset, split=split, scene=scene):
            yield split_sample
            done(split_sample[1])

    lost = FORMS[form](samples(), out)
    for name in _RIGHTS:
        if (data := dataset.files.read(name)) is not None:
            write_atomically(out / name, data)
    return lost or ()
