"""Folder of OpenEXR pictures from elsewhere, judged beside renderers; all are checked first."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.exports.scenes import picture_name
from pipeline.exchange.pictures import MAX_BYTES, decode_pixels
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.safe_read import read_plain
from storage.records.sample import Sample
from train.evaluation.stored_pictures import PictureSource

_LEAST = -1e-2
"""Least radiance that still counts as a network's rounding of 0."""

Views = Sequence[tuple[str, int]]
"""Scene key and camera of every evaluated view."""


def picture_folder(folder: Path, views: Views, widths: Sequence[int]) -> PictureSource:
    """Return a folder of pictures from elsewhere, all of one width, after checking every view's.

    Values slightly below 0, which networks of logarithms return, count as 0; alpha is ignored.

    Raises:
        TrilightError: a picture is missing, unreadable, of another width than the first one or than
            the evaluated ones, or has values that are not finite or below 0.
    """
    _require_all(folder, views)
    sha256: dict[tuple[str, int], str] = {}
    by_width: dict[int, Path] = {}
    for key, view in views:
        path = folder / picture_name(key, view)
        data = _bytes_of(path)
        by_width.setdefault(_picture(data, path, widths).shape[0], path)
        sha256[key, view] = sha256_hex(data)
    if len(by_width) > 1:
        listed = ", ".join(f"{path.name} has {width}" for width, path in by_width.items())
        raise TrilightError(
            f"--pictures {folder}: its pictures have several widths ({listed}); expected one. "
            "Put those of each width into a folder of their own."
        )
    (resolution,) = by_width

    def pictures(sample: Sample) -> NDArray[np.float32]:
        names = [picture_name(sample.key, view) for view in range(sample.scene.num_views)]
        paths = [folder / name for name in names]
        read = [_picture(_bytes_of(path), path, [resolution]) for path in paths]
        return np.maximum(np.stack(read), 0)

    return PictureSource(
        name=f"pictures of {folder.name or folder.resolve().name}",
        resolution=resolution,
        digest=lambda key, view: sha256[key, view],
        pictures=pictures,
    )


def _require_all(folder: Path, views: Views) -> None:
    if not folder.is_dir():
        raise TrilightError(f"--pictures {folder}: no such folder; expected one.")
    missing = [name for name in views if not (folder / picture_name(*name)).is_file()]
    if missing:
        raise TrilightError(
            f"--pictures {folder}: {len(missing)} of {len(views)} pictures are missing, the first "
            f"is {picture_name(*missing[0])}; expected one for each view, called as `trilight "
            "export SET --form exr` calls them. Fewer scenes can be judged (--scenes of "
            "leaderboard, --most-scenes of evaluate)."
        )


def _bytes_of(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise TrilightError(f"{path.name}: expected a picture of at most {MAX_BYTES} bytes.")
        return read_plain(path)
    except OSError as error:
        raise TrilightError(f"{path.name}: cannot be read ({error.strerror}).") from error


def _picture(data: bytes, path: Path, widths: Sequence[int]) -> NDArray[np.float32]:
    """Return the radiance [R, R, 3] of a file whose width is one of `widths`."""
    pixels = decode_pixels(data, path.name)
    if pixels is None or pixels.dtype != np.float32 or pixels.shape[2] < 3:
        raise TrilightError(
            f"{path.name}: no readable OpenEXR picture of channels R, G and B; expected linear "
            "radiance as `trilight export SET --form exr` writes it."
        )
    height, width = pixels.shape[:2]
    if height != width or width not in widths:
        expected = " or ".join(f"{each} x {each}" for each in widths)
        raise TrilightError(
            f"{path.name}: {width} x {height} pixels; expected {expected}. Render it at that size, "
            "or choose another width."
        )
    radiance_rgb = np.asarray(pixels[..., :3], np.float32)
    legal = np.isfinite(radiance_rgb) & (radiance_rgb >= _LEAST)
    if not legal.all():
        _refuse(radiance_rgb, legal, path.name)
    return radiance_rgb


def _refuse(radiance_rgb: NDArray[np.float32], legal: NDArray[np.bool_], name: str) -> None:
    row, column, channel = (int(place) for place in np.argwhere(~legal)[0])
    raise TrilightError(
        f"{name}: row {row}, column {column} is {radiance_rgb[row, column].tolist()}, and "
        f"{int((~legal).any(axis=-1).sum())} pixels are like it; expected finite radiance of at "
        f"least 0 (channel {'RGB'[channel]}). Make the picture again."
    )


def picture_folders(
    folders: Sequence[Path], views: Views, widths: Sequence[int]
) -> list[PictureSource]:
    """Return the checked folders; raises TrilightError for equal names."""
    all_folders: list[PictureSource] = []
    for folder in folders:
        one = picture_folder(folder, views, widths)
        if one.name in [other.name for other in all_folders]:
            raise TrilightError(
                f"--pictures {folder}: another folder has the same name; expected different ones."
            )
        all_folders.append(one)
    return all_folders
