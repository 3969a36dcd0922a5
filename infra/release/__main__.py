"""`make release`: adds the network, a page and checksums to a finished dataset.

    python -m infra.release FOLDER

FOLDER holds `dataset`, an output of `trilight generate`. `network` and `gallery` are written next
to it; each of the three is a repository of a hub.
"""

import shutil
from pathlib import Path
from typing import Annotated

import cyclopts
from cyclopts import Parameter

from infra.cli.console import first_words, next_step, print_rows, progress_bars
from infra.release.push_to_hub import NETWORK_FILE, kind_of, require_within_limits
from infra.release.release_page import chosen_scenes, compare_scenes, write_page
from model.open import BUILTIN_NETWORKS
from pipeline.documents.checksums import write_sums
from storage.atomic import write_atomically
from storage.dataset.dataset import open_dataset
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.markdown import front_matter
from storage.records.objects import read_objects_lock

FREE = {"CC0-1.0"}
"""Licences under which pictures are published."""

_CHECKPOINT = "builtin:hits"


def main(
    folder: Annotated[Path, Parameter(help="folder that holds dataset")],
    pictures: Annotated[int, Parameter(help="scenes on the page")] = 24,
) -> None:
    """Write network, gallery and checksums next to a finished dataset."""
    first_words(f"Releasing {folder}")
    place = folder / "dataset"
    dataset = open_dataset(str(place))
    verification = verify_dataset(dataset)
    if verification.problems or not verification.is_finished:
        raise TrilightError(f"{place}: unfinished or damaged; see trilight verify {place}.")
    licences = {entry.licence for entry in read_objects_lock(dataset.folder.objects_lock)}
    if licences - FREE:
        named = ", ".join(sorted(licences - FREE))
        raise TrilightError(f"{place}: objects under {named}; a release has CC0 only.")
    _write_network(folder / "network")
    chosen = chosen_scenes(dataset, pictures)
    with progress_bars() as bars:
        task = bars.add_task("scenes", total=len(chosen), note="")
        comparisons = list(
            compare_scenes(dataset, chosen, checkpoint=_CHECKPOINT, done=lambda: bars.advance(task))
        )
    about = [
        ("dataset", f"{dataset.manifest.build}, digest {dataset.digest}"),
        ("network", _CHECKPOINT),
        ("scenes", f"{len(comparisons)} of {dataset.manifest.num_samples}"),
    ]
    write_page(folder / "gallery", comparisons, about=about)
    _sum_and_say(folder)


def _write_network(folder: Path) -> None:
    source = BUILTIN_NETWORKS[_CHECKPOINT]
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, folder / NETWORK_FILE)
    front = front_matter(
        {"license": "mit", "library_name": "trilight", "tags": ["neural-rendering", "trilight"]}
    )
    card = source.with_name("README.md").read_text()
    write_atomically(folder / "README.md", f"{front}\n{card}".encode())


def _sum_and_say(folder: Path) -> None:
    parts = [folder / name for name in ("dataset", "network", "gallery")]
    rows = []
    for part in parts:
        write_sums(part)
        files, num_bytes = require_within_limits(part)
        size = f"{files} files, {num_bytes / 1e6:.1f} MB, a {kind_of(part)}"
        rows.append((str(part), size))
    print_rows("Ready for a hub", rows)
    next_step(*(["push", str(part), f"USER/{part.name}", "--dry-run"] for part in parts))


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except TrilightError as mistake:
        raise SystemExit(str(mistake)) from mistake
