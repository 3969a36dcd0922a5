"""A dataset made of finished datasets: its shards, then its documents, then all of it at once.

It is written into a hidden folder beside its place, which is renamed when it is whole. A killed run
leaves that folder, and the next one clears it.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.documents.dataset_documents import write_documents
from pipeline.shards.derive import Derive, derive_shards
from pipeline.shards.finished import open_finished
from storage.atomic import write_error
from storage.dataset.dataset import open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.statistics import Statistics
from storage.errors import TrilightError


def derive_dataset(
    places: Sequence[str],
    derive: Derive,
    out: Path,
    *,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[str, Statistics]:
    """Make a dataset of finished ones.

    Args:
        places: folders of the sources.
        derive: what to make of them.
        out: its folder, which must not exist or be empty.
        progress: called with the shards that are read or written so far, and with their number.

    Returns:
        The dataset digest, and what the dataset holds.

    Raises:
        TrilightError: as `pipeline.shards.derive.derive_shards`, or `out` holds something.
    """
    out = Path(os.path.realpath(out))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise TrilightError(
            f"{out}: is there already; expected a new folder. Choose another --out."
        )
    sources = [open_finished(place) for place in places]
    work = DatasetFolder(out.with_name(f".{out.name}.part"))
    with work.locked():
        _clear(work)
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


def _clear(work: DatasetFolder) -> None:
    """Delete what a killed run left; call only while holding the folder's lock."""
    for path in work.root.iterdir():
        if path == work.staging:
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
