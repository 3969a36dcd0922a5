"""Makes a dataset of finished datasets: its shards, then its documents.

It is written into a hidden folder beside its path, which is renamed when it is complete. A killed
run leaves that folder, and the next one clears it.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.documents.dataset_documents import write_documents
from pipeline.shards.derive import DeriveOptions, derive_shards
from pipeline.shards.finished_dataset import open_finished
from storage.atomic import write_error
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError


def derive_dataset(
    paths: Sequence[str],
    derive: DeriveOptions,
    out: Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[str, Statistics]:
    """Make a dataset of finished ones by merging, selecting or resharding.

    Args:
        out: folder of the new dataset, which must not exist or be empty.
        progress: called with the number of shards read or written so far, and the total.

    Returns:
        The dataset digest, and the statistics of the dataset.

    Raises:
        TrilightError: as `pipeline.shards.derive.derive_shards`, or `out` is not empty.
    """
    out = Path(os.path.realpath(out))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(
            f"{out}: is there already; expected a new folder. Choose another --out."
        )
    sources = [open_finished(path) for path in paths]
    work = DatasetFolder(out.with_name(f".{out.name}.part"))
    with work.hold_exclusive_lock():
        work.clear()  # what a killed run has left
        try:
            derive_shards(sources, derive, work, progress=progress)
            dataset = open_dataset(str(work.root))
            statistics = write_documents(dataset)
            os.replace(work.root, out)
        except OSError as error:
            raise write_error(out, error) from error
        finally:
            shutil.rmtree(work.root, ignore_errors=True)
        shutil.rmtree(DatasetFolder(out).staging, ignore_errors=True)
    return dataset.digest, statistics
