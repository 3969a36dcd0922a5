"""Files of `--out`: one picture, or a folder of numbered pictures with or without a video.

Videos are H.264 in .mp4, which every player reads, or animated .webp. WebP needs only Pillow and is
shown by browsers; MP4 is written by FFmpeg through PyAV.
"""

import io
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image

from storage.atomic import write_atomically, write_error
from storage.errors import TrilightError

SUFFIXES = (".mp4", ".webp")
_CRF = "16"
"""Quality of H.264: losses are invisible below about 18, and absent at 0."""

_WEBP_QUALITY = 90
_BT709 = 1
_SRGB = 13
_STUDIO_RANGE = 1
"""Color properties of the video, by their numbers in ITU-T H.273 and in FFmpeg."""


@dataclass(frozen=True, kw_only=True)
class OutputPaths:
    """Paths of the pictures and of the video."""

    stem: Path | None
    """Path of the only picture without its suffix; None for many pictures."""
    folder: Path
    video: Path | None

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
    if suffix == ".mp4":
        _av()  # before anything is rendered
    return OutputPaths(stem=None, folder=_writable(out.with_suffix(""), out), video=out)


def _writable(folder: Path, out: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise write_error(out, error) from error
    return folder


def write_video(path: Path, frames: Sequence[Path], fps: int) -> None:
    """Write pictures of equal, even width and height as a video.

    A .webp takes all pictures into memory; an .mp4 one after the other.

    Raises:
        TrilightError: the format needs a missing package, or the file cannot be written.
    """
    encode = _mp4 if path.suffix.lower() == ".mp4" else _webp
    write_atomically(path, encode(frames, fps))


def _iter_frames(frames: Sequence[Path]) -> Iterator[Image.Image]:
    for path in frames:
        with Image.open(path) as picture:
            yield picture.convert("RGB")


def _mp4(frames: Sequence[Path], fps: int) -> bytes:
    av = _av()
    stream = io.BytesIO()
    with av.open(stream, "w", format="mp4") as container:
        track: Any = None
        for picture in _iter_frames(frames):
            if track is None:
                track = container.add_stream("libx264", Fraction(fps), options={"crf": _CRF})
                track.width, track.height = picture.size
                track.pix_fmt = "yuv420p"
                track.codec_context.thread_count = 1  # more once gave other bytes
                track.codec_context.colorspace = _BT709  # without it players guess by the size
                track.codec_context.color_primaries = _BT709
                track.codec_context.color_trc = _SRGB
                track.codec_context.color_range = _STUDIO_RANGE
            frame = av.VideoFrame.from_image(picture)
            container.mux(track.encode(frame.reformat(format="yuv420p", dst_colorspace=_BT709)))
        container.mux(track.encode(None))
    return stream.getvalue()


def _webp(frames: Sequence[Path], fps: int) -> bytes:
    first, *remaining = _iter_frames(frames)
    stream = io.BytesIO()
    first.save(
        stream,
        "WEBP",
        save_all=True,
        append_images=remaining,
        duration=round(1000 / fps),
        loop=0,
        quality=_WEBP_QUALITY,
    )
    return stream.getvalue()


def _av() -> Any:
    try:
        import av
    except ImportError as error:
        raise TrilightError(
            "--out X.mp4 needs PyAV, which is not installed: pip install av (it holds x264, GPL), "
            "or choose --out X.webp."
        ) from error
    return av
