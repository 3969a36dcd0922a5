"""Files of `--out`: one picture, or a folder of numbered pictures with or without a video."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from infra.render.video import SUFFIXES, require_encoder
from storage.atomic import write_error
from storage.errors import TrilightError


@dataclass(frozen=True, kw_only=True)
class OutputPaths:
    """Paths of the pictures and of the video."""

    stem: Path | None
    """Path of the only picture without its suffix; None for many pictures."""
    folder: Path
    """Folder that receives the pictures."""
    video: Path | None
    """Path of the video; None without one."""

    @property
    def is_sequence(self) -> bool:
        """True where there may be many pictures."""
        return self.stem is None

    def stem_of(self, index: int) -> Path:
        """Return the path of a picture without its suffix."""
        return self.stem or self.folder / f"{index:06d}"


def output_paths(out: Path) -> OutputPaths:
    """Return the paths that `--out` stands for, and make their folder.

    Raises:
        TrilightError: an unknown suffix, a video without its encoder, or a folder that cannot be
            written.
    """
    suffix = out.suffix.lower()
    if out.is_dir() or not suffix:
        return OutputPaths(stem=None, folder=_writable(out, out), video=None)
    if suffix == ".exr":
        return OutputPaths(stem=out.with_suffix(""), folder=_writable(out.parent, out), video=None)
    if suffix not in SUFFIXES:
        raise TrilightError(
            f"--out is {out}; expected picture.exr, or for many pictures a folder, or X.mp4 or "
            "X.webp, beside which they are kept in a folder X."
        )
    require_encoder(out)
    return OutputPaths(stem=None, folder=_writable(out.with_suffix(""), out), video=out)


def _writable(folder: Path, out: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise write_error(out, error) from error
    return folder
