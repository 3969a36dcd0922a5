"""Untrusted pictures: decoded within limits, and sampled with the wrap mode of their format.

The slot of a picture decides on its encoding, not the picture itself: base colors are sRGB-encoded
and roughness is linear, whatever profile or gamma the file names.
"""

import io
import warnings
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from pipeline.foreign import openexr, radiance_hdr
from pipeline.foreign.linear_picture import LinearPicture, clip_to_unit, require_pixels
from storage.conventions import linear_from_srgb, linear_from_srgb8
from storage.errors import Rejected
from storage.records.exr import MAGIC

Wrap = Literal["repeat", "clamp", "mirror", "black"]
"""Wrap modes; `black` is 0 beyond the picture, alpha included."""

T = TypeVar("T")

FORMATS = ("PNG", "JPEG", "WEBP", "TGA", "BMP", "TIFF")
"""Formats that are decoded; a file of another one is refused by its content."""

UNREADABLE_PICTURE = (
    "it is cut off or damaged, or no PNG, JPEG, WebP, TGA, BMP, TIFF, OpenEXR or Radiance picture; "
    "write it again"
)
"""Text that records hold for such a picture, since they never quote a library."""

MAX_BYTES = 256 << 20
MAX_PIXELS = 64 << 20
"""Maximum size of one picture of a scene; those of an object have a common one (`FilePictures`)."""

_STRIP = 256  # rows; an even number, since pairs of rows are averaged
_MOST = 65504.0
"""Largest number of a half float."""


def read_linear_picture(
    data: bytes, max_pixels: int, *, is_color: bool = True
) -> LinearPicture | None:
    """Return the floats of an OpenEXR or Radiance picture in linear Rec.709, or None for others.

    The first bytes decide on the format.

    Args:
        data: the file.
        max_pixels: maximum number of pixels, checked before memory is allocated.
        is_color: whether its numbers are colors, which its primaries apply to.

    Raises:
        Rejected: not_hdr, load_error or too_many_pixels.
    """
    try:
        if data.startswith(MAGIC):
            return openexr.read_openexr(data, max_pixels, is_color=is_color)
        if data.startswith(radiance_hdr.MAGIC):
            return radiance_hdr.read_radiance_hdr(data, max_pixels, is_color=is_color)
    except (ValueError, LookupError, ArithmeticError) as error:  # such as names that are not UTF-8
        raise Rejected("load_error", "it is damaged; write it again") from error
    return None


class FilePictures:
    """The pictures of one object or of one scene, each decoded once.

    Those of an object have a common bound of pixels, and one that is not read refuses the object.
    Each of a scene has a bound of its own, and is left out with a note.
    """

    def __init__(self, max_pixels: int, *, lost: list[str] | None = None) -> None:
        """Set the bound; `lost` receives the notes on a scene, None is for an object."""
        self._pixels_left = max_pixels
        self._values: dict[Hashable, NDArray] = {}
        self.of_scene = lost is not None
        self.notes: list[str] = [] if lost is None else lost
        """Sentences on parts of the pictures that are not read."""

    def decode(self, key: Hashable, name: str, read: Callable[[], bytes]) -> NDArray:
        """Return `decode_image` of the bytes that `read` returns, once for each `key`."""
        if key not in self._values:
            values = decode_image(
                read(), name, self._pixels_left, self.notes, of_scene=self.of_scene
            )
            self._pixels_left -= 0 if self.of_scene else values.shape[0] * values.shape[1]
            self._values[key] = values
        return self._values[key]

    def read_or_leave_out(self, where: str, read: Callable[[], T]) -> T | None:
        """Return what `read` returns; None, with a note, where a scene lacks its picture.

        Raises:
            Rejected: texture_outside, texture_too_large; of an object, as `read`.
        """
        try:
            return read()
        except Rejected as why:
            if not self.of_scene or why.reason in ("texture_outside", "texture_too_large"):
                raise
            self.notes.append(f"{where}a texture is left out: {why.message}")
            return None


def decode_image(
    data: bytes, name: str, max_pixels: int, notes: list[str], *, of_scene: bool = False
) -> NDArray:
    """Return a picture [H, W, 4], row 0 at the bottom: uint8, or uint16 for grays of 16 bits.

    Palettes, grays, transparency and CMYK become RGBA; colors of 16 bits are reduced to 8. OpenEXR
    and Radiance are float16, clipped to 0 from below; emission may exceed 1, other slots cut it.
    `notes` receives sentences on what is not read, cut, or replaced. In pictures of scenes NaN
    becomes 0; those of objects are refused for it.

    Raises:
        Rejected: texture_too_large or texture_unreadable.
    """
    try:
        linear = read_linear_picture(data, max_pixels)
        if linear is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # ours is stricter
                with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                    if of_scene:
                        require_pixels(image.width, image.height, max_pixels)
                    if image.width * image.height > max_pixels:
                        raise Rejected(
                            "texture_too_large",
                            f"{image.width} x {image.height}; at most {max_pixels} "
                            "pixels are left. Make it smaller, or raise own_materials.max_pixels",
                        )
                    if image.mode != "F":
                        return np.ascontiguousarray(_decode_values(image)[::-1])
                    linear = LinearPicture(values=np.asarray(image, np.float32)[..., None])
        values = linear.values
        sentences = list(linear.unread)
        if of_scene and not np.isfinite(values).all():
            sentences.append("texels that are no finite numbers: NaN replaced by 0")
            values = np.nan_to_num(values, nan=0.0)
        sentences += clip_to_unit(values)[1]
        notes.extend(f"picture {name[:60]!r}: {note}" for note in sentences)
        return np.ascontiguousarray(_to_rgba(values)[::-1])
    except MemoryError:
        raise
    except Rejected as error:
        large = error.reason in ("texture_too_large", "too_many_pixels")
        reason = "texture_too_large" if large else "texture_unreadable"
        raise Rejected(reason, f"{name!r:.80}: {error.message}") from error
    except UnidentifiedImageError as error:
        why = f"it is no picture that is read; expected {', '.join(FORMATS)} or OpenEXR"
        raise Rejected("texture_unreadable", f"{name!r:.80}: {why}") from error
    except Image.DecompressionBombError as error:
        raise Rejected("texture_too_large", f"{name!r:.80}: it has too many pixels") from error
    except Exception as error:  # decoders of other people's files fail in every way
        raise Rejected("texture_unreadable", f"{name!r:.80}: {UNREADABLE_PICTURE}") from error


def has_colors(data: bytes) -> bool:
    """Return whether a picture of 8 bits has colors, which USD assumes to be sRGB by default.

    False for bytes that no decoder reads, too.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                return image.mode in ("RGB", "RGBA", "P", "CMYK", "YCbCr")
    except Exception:  # decoders of other people's files fail in every way
        return False


def _to_rgba(values: NDArray[np.float32]) -> NDArray[np.float16]:
    """Return RGBA [H, W, 4] of linear values [H, W, 1 to 4]; alpha is clipped to [0, 1]."""
    count = values.shape[2]
    rgba = np.ones((*values.shape[:2], 4), np.float16)
    rgba[..., :3] = np.clip(values[..., :3] if count >= 3 else values[..., :1], 0, _MOST)
    if count in (2, 4):
        rgba[..., 3] = np.clip(values[..., -1], 0, 1)
    return rgba


def _decode_values(image: Image.Image) -> NDArray:
    if image.mode.startswith("I"):
        gray = np.clip(np.asarray(image), 0, 65535).astype(np.uint16)
        return np.stack([gray, gray, gray, np.full_like(gray, 65535)], axis=-1)
    return np.asarray(image.convert("RGBA"))


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """Values over texture coordinates, u to the right and v up; those of floats may exceed 1."""

    values: NDArray
    """[H, W, 4] as `decode_image` returns them, or linear float32."""
    is_srgb: bool
    """True where red, green and blue are sRGB-encoded; alpha never is."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Wrap modes along u and v."""
    is_nearest: bool = False
    """True where texels are flat squares instead of being interpolated."""
    _levels: list[NDArray[np.float32]] = field(default_factory=list, init=False)

    def level(self, number: int) -> NDArray:
        """Return the picture halved `number` times, linear from the first halving on."""
        if number == 0:
            return self.values
        if not self._levels:  # strips: a whole large picture in floats takes too much memory
            rows = range(0, len(self.values), _STRIP)
            strips = [_halve(self.linear(self.values[row : row + _STRIP])) for row in rows]
            self._levels.append(np.concatenate(strips))
        while len(self._levels) < number:
            self._levels.append(_halve(self._levels[-1]))
        return self._levels[number - 1]

    @property
    def max_halvings(self) -> int:
        """Return the number of halvings until one texel is left."""
        return max(self.values.shape[:2]).bit_length() - 1

    def linear(self, texels: NDArray) -> NDArray[np.float32]:
        """Return the linear values of texels [..., 4] of the picture or of a level."""
        if texels.dtype == np.float32:
            return texels
        most = 1 if texels.dtype == np.float16 else np.iinfo(texels.dtype).max
        linear: NDArray[np.float32] = np.divide(texels, most, dtype=np.float32)
        if self.is_srgb and texels.dtype == np.uint8:
            linear[..., :3] = linear_from_srgb8()[texels[..., :3]]
        elif self.is_srgb:
            linear[..., :3] = linear_from_srgb(linear[..., :3])
        return linear

    def sample(self, uv: NDArray[np.float64], halvings: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return linear values [N, 4] at coordinates [N, 2], each of the given halving."""
        values = np.zeros((len(uv), 4), np.float32)
        for number in np.unique(halvings):
            chosen = halvings == number
            values[chosen] = self._sample_level(uv[chosen], self.level(int(number)))
        return values

    def _sample_level(self, uv: NDArray[np.float64], texels: NDArray) -> NDArray[np.float32]:
        (x0, x1, along), (y0, y1, across) = (
            _find_texels(uv[:, axis], texels.shape[1 - axis], self.wrap[axis], self.is_nearest)
            for axis in (0, 1)
        )
        low = (1 - along) * self.linear(texels[y0, x0]) + along * self.linear(texels[y0, x1])
        high = (1 - along) * self.linear(texels[y1, x0]) + along * self.linear(texels[y1, x1])
        values: NDArray[np.float32] = ((1 - across) * low + across * high).astype(np.float32)
        is_black = [wrap == "black" for wrap in self.wrap]
        values[(((uv < 0) | (uv > 1)) & is_black).any(axis=1)] = 0
        return values


def spread_points(steps: int = 8) -> NDArray[np.float64]:
    """Return barycentric coordinates [P, 3] of points evenly over a triangle, `steps` an edge."""
    rows = [(i, j) for i in range(steps) for j in range(steps - i)]
    u, v = (np.array(rows, np.float64).T + 1 / 3) / steps
    return np.stack([u, v, 1 - u - v], axis=1)


def _halve(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return means of two by two texels; the last row or column of an odd number stays alone."""
    for axis in (0, 1):
        count = values.shape[axis]
        if count > 1:
            starts = np.arange(0, count, 2)
            sums = np.add.reduceat(values, starts, axis=axis)
            sizes = np.minimum(count - starts, 2).astype(np.float32)
            values = sums / np.expand_dims(sizes, tuple(k for k in range(3) if k != axis))
    return values


def _find_texels(
    at: NDArray[np.float64], count: int, wrap: Wrap, is_nearest: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the two texels [N] around coordinates [N] on an axis, and the second's weight [N, 1].

    Where texels are not interpolated, the first is the nearest one, and the second weighs nothing.
    """
    if wrap in ("clamp", "black"):
        wrapped = np.clip(at, 0, 1)
    else:
        wrapped = 1 - np.abs(np.mod(at, 2) - 1) if wrap == "mirror" else at - np.floor(at)
    position = wrapped * count - 0.5
    if is_nearest:
        position = np.floor(position + 0.5)
    first = np.floor(position).astype(np.int64)
    both = np.stack([first, first + 1])
    low, high = both % count if wrap == "repeat" else np.clip(both, 0, count - 1)
    return low, high, (position - first)[:, None]
