"""Page of a release: traced, network, error and few samples side by side; works from disk."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from infra.release.pictures import NETWORK, SceneComparison
from pipeline.documents.pages import Figure, render_page
from pipeline.documents.png import encode_png
from storage.atomic import write_atomically
from storage.conventions import preview_srgb8
from storage.markdown import front_matter
from train.evaluation.sheet import ERROR_WHITE, error_picture

_TITLE = "Trilight: traced, learned and filtered"
_PICTURES = "pictures"


def write_page(
    folder: Path, comparisons: Sequence[SceneComparison], *, about: Sequence[tuple[str, str]]
) -> Path:
    """Write `index.html`, its pictures and the README of a static space; return the page's path.

    Pictures of an earlier page, which would be uploaded, too, are deleted.

    Args:
        folder: folder of the page.
        comparisons: scenes, each rendered by the same methods.
        about: facts of the pictures, as names and values.

    Raises:
        TrilightError: the folder cannot be written.
    """
    for old in sorted((folder / _PICTURES).glob("[0-9]" * 9 + "-*.png")):
        old.unlink()
    page = render_page(
        "release.html",
        _TITLE,
        explained=_EXPLAINED,
        about=about,
        medians=list(_medians(comparisons)),
        scenes=[(each, list(_pictures(folder, each))) for each in comparisons],
    )
    path = folder / "index.html"
    write_atomically(path, page)
    card = front_matter({"title": _TITLE, "sdk": "static", "license": "cc0-1.0"})
    write_atomically(folder / "README.md", f"{card}\n# {_TITLE}\n\n{_EXPLAINED}\n".encode())
    return path


_EXPLAINED = (
    "First views of scenes of built-in objects, which are CC0. The figure below a picture is its "
    "psnr_log_db to the traced one, whose own is that of its noise. In error pictures white is a "
    f"difference of {ERROR_WHITE} in log10(1 + radiance)."
)


def _pictures(folder: Path, each: SceneComparison) -> Iterator[Figure]:
    """Write the pictures of a scene, and yield them."""
    error = error_picture(each.pictures_rgb[NETWORK], each.target_rgb)
    pictures = [
        ("traced", preview_srgb8(each.target_rgb), f"traced, noise floor {each.floor_db:.1f} dB")
    ]
    for place, (name, radiance_rgb) in enumerate(each.pictures_rgb.items()):
        caption = f"{name}, {each.psnr_db[name]:.1f} dB"
        pictures.append((str(place), preview_srgb8(radiance_rgb), caption))
        if name == NETWORK:
            pictures.append(("error", error, "error of the network"))
    for name, pixels, caption in pictures:
        relative = f"{_PICTURES}/{each.key}-{name}.png"
        write_atomically(folder / relative, encode_png(pixels))
        yield Figure(relative, f"{each.key}, {caption}", caption)


def _medians(comparisons: Sequence[SceneComparison]) -> Iterator[tuple[str, float, float, str]]:
    """Yield each picture's name, median and worst PSNR, and how often it beats the network."""
    for name in comparisons[0].psnr_db:
        values = [each.psnr_db[name] for each in comparisons]
        better = sum(each.psnr_db[name] > each.psnr_db[NETWORK] for each in comparisons)
        beaten = "" if name == NETWORK else f"{better} of {len(comparisons)}"
        yield name, float(np.median(values)), min(values), beaten
