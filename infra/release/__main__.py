"""`make release`: adds the network, a page and checksums to a finished dataset.

    python -m infra.release FOLDER

FOLDER holds `dataset`, an output of `trilight generate`. `network` and `gallery` are written next
to it; each of the three is a repository of a hub. The gallery is a page that works from disk:
traced, network, error and few samples side by side.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import cyclopts
import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from infra.cli.console import Bars, first_words, next_step, print_rows
from infra.release.push_to_hub import NETWORK_FILE, kind_of, require_within_limits
from infra.render.networks import NetworkRenderer
from infra.render.path_tracer import PathTracer, RenderChild
from model.open import BUILTIN_NETWORKS
from pipeline.documents.checksums import write_sums
from pipeline.documents.pages import Figure, render_page
from pipeline.documents.png import encode_png
from pipeline.documents.sheets import choose_scenes, read_chosen
from pipeline.renders.mitsuba_variant import choose_variant
from pipeline.renders.preview import PreviewSettings, samples_text
from storage.atomic import write_atomically
from storage.conventions import SPLITS, preview_srgb8
from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.manifest import ShardEntry
from storage.dataset.verify import verify_dataset
from storage.errors import TrilightError
from storage.markdown import front_matter
from storage.metrics import psnr_log_db
from storage.records.objects import read_objects_lock
from storage.records.sample import Sample
from storage.renderer import Camera, Renderer
from train.evaluation.sheet import ERROR_WHITE, error_picture

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
    with Bars() as bars:
        task = bars.add_task("scenes", total=len(chosen), note="")
        about = [
            ("dataset", f"{dataset.manifest.build}, digest {dataset.digest}"),
            ("network", _CHECKPOINT),
            ("scenes", f"{len(chosen)} of {dataset.manifest.num_samples}"),
        ]
        scenes = compare_scenes(dataset, chosen, done=lambda: bars.advance(task))
        write_page(folder / "gallery", scenes, about=about)
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


_TITLE = "Trilight: traced, learned and filtered"
_PICTURES = "pictures"


RIVALS = (1, 4, 16)
"""Samples per pixel of the previews in the comparison, filtered by Open Image Denoise."""

NETWORK = "network"


ComparedScene = tuple[str, Sample, Mapping[str, NDArray[np.float32]]]
"""Split and sample of a scene, and its first view as [R, R, 3] linear radiance by method."""


def write_page(
    folder: Path, scenes: Iterable[ComparedScene], *, about: Sequence[tuple[str, str]]
) -> Path:
    """Write `index.html`, its pictures and the README of a static space; return the page's path.

    Pictures of an earlier page, which would be uploaded, too, are deleted last.

    Raises:
        TrilightError: the folder cannot be written; or as `compare_scenes`.
    """
    earlier = {*(folder / _PICTURES).glob("[0-9]" * 9 + "-*.png")}
    psnr_db: dict[str, list[float]] = {}
    rows = []
    for split, sample, pictures_rgb in scenes:
        for name, picture in pictures_rgb.items():
            psnr_db.setdefault(name, []).append(psnr_log_db(picture, sample.radiance_rgb[0]))
        last_db = {name: values[-1] for name, values in psnr_db.items()}
        template = sample.scene.provenance.get("template", "unknown")
        caption = f"{split}, {template}, {sample.scene.num_triangles} triangles"
        rows.append((sample.key, caption, list(_pictures(folder, sample, pictures_rgb, last_db))))
    page = render_page(
        "release.html",
        _TITLE,
        explained=_EXPLAINED,
        about=about,
        medians=list(_medians(psnr_db)),
        scenes=rows,
    )
    path = folder / "index.html"
    write_atomically(path, page)
    for old in earlier - {folder / each.source for *_, figures in rows for each in figures}:
        old.unlink()
    card = front_matter({"title": _TITLE, "sdk": "static", "license": "cc0-1.0"})
    write_atomically(folder / "README.md", f"{card}\n# {_TITLE}\n\n{_EXPLAINED}\n".encode())
    return path


_EXPLAINED = (
    "First views of scenes of built-in objects, which are CC0. The figure below a picture is its "
    "psnr_log_db to the traced one, whose own is that of its noise. In error pictures white is a "
    f"difference of {ERROR_WHITE} in log10(1 + radiance)."
)


def _pictures(
    folder: Path,
    sample: Sample,
    pictures_rgb: Mapping[str, NDArray[np.float32]],
    psnr_db: Mapping[str, float],
) -> Iterator[Figure]:
    """Write the pictures of a scene, and yield them."""
    target = sample.radiance_rgb[0]
    stated = f"traced, stated error {sample.views[0].noise_floor_db:.1f} dB"
    pictures = [("traced", preview_srgb8(target), stated)]
    for place, (name, radiance_rgb) in enumerate(pictures_rgb.items()):
        caption = f"{name}, {psnr_db[name]:.1f} dB"
        pictures.append((str(place), preview_srgb8(radiance_rgb), caption))
        if name == NETWORK:
            error = error_picture(radiance_rgb, target)
            pictures.append(("error", error, "error of the network"))
    for name, pixels, caption in pictures:
        relative = f"{_PICTURES}/{sample.key}-{name}.png"
        write_atomically(folder / relative, encode_png(pixels))
        yield Figure(relative, f"{sample.key}, {caption}", caption)


def _medians(psnr_db: Mapping[str, list[float]]) -> Iterator[tuple[str, float, float, str]]:
    """Yield each picture's name, median and worst PSNR, and how often it beats the network."""
    network = psnr_db[NETWORK]
    for name, values in psnr_db.items():
        better = sum(one > other for one, other in zip(values, network, strict=True))
        beaten = "" if name == NETWORK else f"{better} of {len(values)}"
        yield name, float(np.median(values)), min(values), beaten


def chosen_scenes(dataset: Dataset, count: int) -> list[tuple[ShardEntry, str]]:
    """Return shard and key of up to `count` scenes of the test split, or of all if it is empty.

    Raises:
        TrilightError: `count` is below 1, or the dataset is empty.
    """
    judged = any(shard.num_samples for shard in dataset.shards_of("test"))
    splits = ("test",) if judged else SPLITS
    if count < 1 or not (chosen := choose_scenes(dataset, count, splits)):
        raise TrilightError(
            f"--pictures is {count}, of a dataset of {dataset.manifest.num_samples} scenes; "
            "expected at least one scene to show."
        )
    return chosen


def compare_scenes(
    dataset: Dataset, chosen: Sequence[tuple[ShardEntry, str]], *, done: Callable[[], None]
) -> Iterator[ComparedScene]:
    """Yield the comparison of each scene's first view.

    Raises:
        TrilightError: a sample is unreadable, or the network or the path tracer cannot render it.
    """
    with contextlib.closing(RenderChild(choose_variant(), threads=1)) as child:
        by_width: dict[int, Sequence[Renderer]] = {}
        for shard, sample in read_chosen(dataset, chosen):
            width = int(sample.radiance_rgb.shape[1])
            if width not in by_width:
                rivals = [PreviewSettings(resolution=width, spp=spp) for spp in RIVALS]
                by_width[width] = [
                    NetworkRenderer(name=NETWORK, checkpoint=_CHECKPOINT, resolution=width),
                    *(
                        PathTracer(child, one, name=f"{samples_text(one.spp)}, filtered")
                        for one in rivals
                    ),
                ]
            camera = Camera.of_scene(sample.scene, 0)
            pictures = {
                each.name: each.load(sample.scene, sample.key).render(camera).radiance_rgb
                for each in by_width[width]
            }
            yield shard.split, sample, pictures
            done()


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except TrilightError as mistake:
        raise SystemExit(str(mistake)) from mistake
