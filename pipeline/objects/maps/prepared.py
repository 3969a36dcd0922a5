"""Prepared textures and maps, as scenes use them.

The base color of a texture is sRGB-encoded, all else is linear. Means are of linear values; the
mean of roughness is that of the GGX width, its square. There is no Fresnel term here: a surface
with a metallic map, or with a base color alone, gets its albedos from storage.optics.

A NaN or infinite value rejects a map: half floats end at 65,504, so that a brighter sun was written
as infinite and is lost. Small negative values, which color conversions leave, become 0 where
together they are at most a thousandth of the light.

A child process reads a file once, and the user's cache keeps the outcome under a key of all that it
depends on. The cache keeps no refusal: it costs little, and the user may fix the file.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from safetensors.numpy import save
from scipy.sparse import csr_array

from pipeline.foreign.linear_picture import clip_to_unit
from pipeline.foreign.material_files import read_regular
from pipeline.foreign.picture import FORMATS, UNREADABLE_PICTURE, read_linear_picture
from pipeline.objects.maps.texture_names import PACKED, TEXTURE_PARTS
from storage.conventions import linear_from_srgb
from storage.digests import canonical_json, sha256_hex
from storage.errors import Rejected
from storage.optics import constant_albedos
from storage.records.objects import SKY
from storage.records.safe_read import read_safetensors
from storage.records.texture import MAX_RADIANCE, MAX_SIDE, content_digest


def area_means(values: NDArray, height: int, width: int) -> NDArray[np.float64]:
    """Return a flat picture [H, W, C] as [height, width, C] means."""
    return _means(values, _overlaps(_even(len(values)), _even(height)), width)


def solid_angle_means(radiance: NDArray, height: int) -> NDArray[np.float64]:
    """Return a latitude-longitude map [H, 2H, C] as [height, 2 height, C] means by solid angle."""
    rows = _overlaps(_latitudes(len(radiance)), _latitudes(height))
    return _means(radiance, rows, 2 * height)


def flux(radiance: NDArray) -> NDArray[np.float64]:
    """Return the integral [C] over the sphere of a latitude-longitude map [H, W, C]."""
    rows = np.diff(_latitudes(len(radiance))) * 2 * np.pi
    return rows @ radiance.mean(axis=1, dtype=np.float64)


def _means(values: NDArray, rows: csr_array, width: int) -> NDArray[np.float64]:
    height = rows.shape[0]
    channels = values.shape[2]
    columns = _overlaps(_even(values.shape[1]), _even(width))
    result = np.zeros((height, width, channels))
    for channel in range(channels):  # one at a time: the largest maps take a gigabyte
        result[..., channel] = (columns @ (rows @ values[..., channel].astype(np.float64)).T).T
    return result


def _even(count: int) -> NDArray[np.float64]:
    return np.arange(count + 1) / count


def _latitudes(count: int) -> NDArray[np.float64]:
    """Return the borders of a map's rows as heights 1 - cos on the sphere."""
    return 1 - np.cos(np.pi * np.arange(count + 1) / count)


def _overlaps(source: NDArray[np.float64], target: NDArray[np.float64]) -> csr_array:
    """Return the fraction [target, source] of each target interval that each source covers."""
    ends = np.union1d(source, target)
    ends = ends[np.concatenate([[True], np.diff(ends) > 1e-12])]  # rounding makes two of one
    middle = (ends[:-1] + ends[1:]) / 2
    into = np.clip(np.searchsorted(target, middle) - 1, 0, len(target) - 2)
    out_of = np.clip(np.searchsorted(source, middle) - 1, 0, len(source) - 2)
    fraction = np.diff(ends) / np.diff(target)[into]
    return csr_array((fraction, (into, out_of)), shape=(len(target) - 1, len(source) - 1))


MOST_BYTES = 1 << 30
"""Largest accepted size of one file, in bytes."""

MOST_ROWS = 4096
"""Largest number of rows of a map; columns are at most twice as many."""

_RECIPE = 3
"""Version of the outcomes; raise it when the result for a file changes."""

_MOST_HEADER = 1 << 12

MOST_NEGATIVE = 1e-3
"""Largest fraction of a map's light that its negative values may take away."""

MAX_PIXELS = 1 << 26
"""Most pixels of a picture: 8192 x 8192."""

_MOST = {"I;16": 65535, "I;16L": 65535, "I;16B": 65535, "I": 65535}


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedMap:
    """A prepared texture or map."""

    content_sha256: str
    """Digest that decides the split: of the base color, or of the whole map, as read."""
    arrays: Mapping[str, NDArray[np.float32]]
    """Arrays, the top row first: "radiance" of a map; "diffuse" [H, W, 3] and "specular" [H, W, 3]
    of a texture, at most 1 together, and "roughness" [H, W, 1] where there is a picture of it."""

    def encode(self) -> bytes:
        """Return the bytes of its file."""
        return save(dict(self.arrays), {"content": self.content_sha256})


def decode_prepared(data: bytes, name: str) -> PreparedMap:
    """Decode the bytes of `encode`; raises TrilightError where the file is damaged."""
    arrays, metadata = read_safetensors(data, _MOST_HEADER, name=name)
    return PreparedMap(content_sha256=metadata["content"], arrays=arrays)


def map_cache_key(kind: str, files: Mapping[str, Path], size: int) -> str:
    """Return the cache key of the outcome of `prepare_map`: a digest of the files and the rest.

    Raises:
        Rejected: missing_file, too_large_bytes.
    """
    digests = {part: sha256_hex(_read(path)) for part, path in files.items()}
    return sha256_hex(canonical_json([kind, digests, size, _RECIPE]))[:32]


def prepare_map(kind: str, files: Mapping[str, Path], size: int) -> tuple[bytes, tuple[str, ...]]:
    """Return the file of a texture or map, and notes on unread parts; for child processes.

    Args:
        kind: TEXTURE or SKY.
        files: picture files by component; a map has one, "map".
        size: most texels along a side of a texture; most rows of a map.

    Raises:
        Rejected: the reason and a remedy; see `usable_map`, `texture_set` and the readers.
    """
    if kind == SKY:
        return _prepare_sky(_read(files["map"]), size)
    pictures: dict[str, NDArray[np.float32]] = {}
    unread: list[str] = []
    for part, path in sorted(files.items()):
        try:
            values, notes = picture_values(_read(path), is_color=part == "base")
        except Rejected as rejection:
            raise Rejected(rejection.reason, f"{part}: {rejection.message}") from rejection
        unread += [f"{note} of its {part}" for note in notes]
        if part in PACKED and values.shape[2] < 3:
            unread.append(f"its {part}, which is gray: it has no channels")
        pictures[part] = values
    if "base" in pictures and are_normals(pictures["base"]):
        raise Rejected(
            "unknown_map", "its values are unit vectors, as of a normal map; end it in _normal"
        )
    return texture_set(unpack_parts(pictures), size).encode(), tuple(unread)


def _prepare_sky(data: bytes, rows: int) -> tuple[bytes, tuple[str, ...]]:
    picture = read_linear_picture(data, 2 * MOST_ROWS * MOST_ROWS)
    if picture is None:
        raise Rejected("not_hdr", "it is neither an OpenEXR nor a Radiance file; write it again")
    grey = picture.values.shape[2] < 3
    radiance = np.ascontiguousarray(picture.values[..., [0, 0, 0] if grey else [0, 1, 2]])
    prepared = PreparedMap(
        content_sha256=content_digest("radiance", radiance),
        arrays={"radiance": np.ascontiguousarray(usable_map(radiance, rows))},
    )
    return prepared.encode(), picture.unread


def texture_set(pictures: Mapping[str, NDArray[np.float32]], size: int) -> PreparedMap:
    """Return a texture.

    Args:
        pictures: encoded values [H, W, 1 or 3] of the component "base", and of "specular",
            "roughness" and "metallic" where present. They may differ in size.
        size: most texels along a side of the result.
    """
    base = pictures["base"]
    shrink = min(1.0, size / max(base.shape[:2]))
    height, width = (max(1, round(side * shrink)) for side in base.shape[:2])

    def means(values: NDArray) -> NDArray[np.float64]:
        return area_means(values, height, width)

    color = _three(means(linear_from_srgb(base).astype(np.float32)))
    metallic = means(_grey(pictures["metallic"])) if "metallic" in pictures else np.zeros(1)
    if "specular" in pictures:
        diffuse = color * (1 - metallic)
        # where both are over 1, the lobe gives way
        specular = np.minimum(_three(means(pictures["specular"])), 1 - diffuse)
    else:
        diffuse, specular = constant_albedos(color, metallic)
        specular = np.broadcast_to(specular, diffuse.shape)
    arrays = {
        "diffuse": diffuse.astype(np.float32),
        "specular": np.ascontiguousarray(specular, np.float32),
    }
    if "roughness" in pictures:
        widths = means(np.square(_grey(pictures["roughness"])))
        arrays["roughness"] = np.sqrt(widths).astype(np.float32)
    # Copies share the digest of the base color as read, whatever their other pictures.
    return PreparedMap(content_sha256=content_digest("base colour", base), arrays=arrays)


def _grey(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return values.mean(axis=2, keepdims=True, dtype=np.float32)


def _three(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.repeat(values, 3, axis=2) if values.shape[2] == 1 else values


def unpack_parts(
    pictures: Mapping[str, NDArray[np.float32]],
) -> Mapping[str, NDArray[np.float32]]:
    """Return the components of a texture; separate pictures win over packed channels."""
    parts = dict(pictures)
    for name, values in pictures.items():
        for part, channel in PACKED.get(name, {}).items():
            if part not in parts and values.shape[2] == 3:
                parts[part] = values[..., channel : channel + 1]
    if "gloss" in parts and "roughness" not in parts:
        parts["roughness"] = 1 - parts["gloss"]
    return {part: values for part, values in parts.items() if part in TEXTURE_PARTS}


def _read(path: Path) -> bytes:
    try:
        return read_regular(path, MOST_BYTES)
    except OSError as error:
        raise Rejected("missing_file", f"cannot be read ({error.strerror})") from error


def picture_values(data: bytes, *, is_color: bool) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return a picture [H, W, 1 or 3], the top row first, and notes on unread parts.

    Alpha is left out. Floats are linear; float colors are encoded to sRGB here.

    Raises:
        Rejected: load_error, not_hdr, not_a_number, too_many_pixels.
    """
    linear = read_linear_picture(data, MAX_PIXELS, is_color=is_color)
    if linear is None:
        values, is_linear = _plain_values(data)
        unread: tuple[str, ...] = ()
    else:
        values = linear.values[..., : 3 if linear.values.shape[2] >= 3 else 1]
        is_linear = True
        unread = linear.unread
        if max(values.shape) > MAX_SIDE:
            raise _too_large(values.shape[1], values.shape[0])
    values, cut = clip_to_unit(values)
    if is_linear and is_color:
        curve = 1.055 * values ** (1 / 2.4) - 0.055
        values = np.where(values <= 0.0031308, values * 12.92, curve).astype(np.float32)
    return values, (*unread, *cut)


def are_normals(values: NDArray[np.float32]) -> bool:
    """Return whether nearly all values [H, W, 3] code unit vectors, most of them along +Z."""
    vectors = 2 * values - 1
    is_unit = np.abs(np.linalg.norm(vectors, axis=2) - 1) < 0.05
    return values.shape[2] == 3 and bool((is_unit & (vectors[..., 2] > 0)).mean() > 0.98)


def _too_large(width: int, height: int) -> Rejected:
    return Rejected(
        "too_many_pixels",
        f"{width} x {height}; expected at most {MAX_PIXELS} in all and {MAX_SIDE} a side: scale it "
        "down",
    )


def _plain_values(data: bytes) -> tuple[NDArray[np.float32], bool]:
    """Return a picture of another format, and True where its values are linear floats."""
    is_linear = False
    try:
        with Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.width * image.height > MAX_PIXELS or max(image.size) > MAX_SIDE:
                raise _too_large(image.width, image.height)
            if image.mode in _MOST:
                values = np.asarray(image, np.float32) / np.float32(_MOST[image.mode])
            elif image.mode == "F":
                values = np.asarray(image, np.float32)
                is_linear = True
            else:
                mode = "L" if image.mode in ("1", "L", "LA") else "RGB"
                values = np.asarray(image.convert(mode), np.float32) / np.float32(255)
    except UnidentifiedImageError as error:
        raise Rejected(
            "load_error",
            "it is cut off, or no PNG, JPEG, TIFF, BMP, TGA or WebP picture that is read; of TIFF, "
            "colors of 16 or 32 bits are not: write it as PNG or OpenEXR",
        ) from error
    except (OSError, SyntaxError, ValueError, LookupError, Image.DecompressionBombError) as error:
        raise Rejected("load_error", UNREADABLE_PICTURE) from error
    return (values if values.ndim == 3 else values[..., None]), is_linear


def usable_map(radiance: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """Return a map of at most `height` rows, by means over solid angle.

    Args:
        radiance: [H, W, 3] linear, the top row first.
        height: most rows of the result; a smaller map stays unchanged.

    Raises:
        Rejected: not_two_to_one, not_a_number, infinite_radiance, negative_radiance,
            too_bright, black_map.
    """
    rows, columns = radiance.shape[:2]
    if columns != 2 * rows:
        raise Rejected(
            "not_two_to_one",
            f"the picture is {columns} x {rows}; expected latitude-longitude, twice as wide as "
            "high: convert cube maps and fisheyes, crop or scale others",
        )
    _refuse(np.isnan(radiance), "not_a_number", "is not a number; mend it in a picture editor")
    _refuse(
        np.isinf(radiance),
        "infinite_radiance",
        "is infinite; write the map in 32 bits, or as .hdr: half floats end at 65504",
    )
    lawful = np.maximum(radiance, 0)
    total = flux(lawful)
    negative = flux(lawful - radiance)
    if (negative > MOST_NEGATIVE * total).any() and negative.any():
        raise Rejected(
            "negative_radiance",
            f"negative values take more than {MOST_NEGATIVE:g} of the light of a channel; set them "
            "to 0 in a picture editor",
        )
    _refuse(lawful > MAX_RADIANCE, "too_bright", f"is over {MAX_RADIANCE:g}; scale the map down")
    if not total.sum() > 0:
        raise Rejected("black_map", "the map is black; expected some light")
    return lawful if rows <= height else solid_angle_means(lawful, height).astype(np.float32)


def _refuse(wrong: NDArray[np.bool_], reason: str, message: str) -> None:
    if wrong.any():
        row, column, channel = (int(i) for i in np.argwhere(wrong)[0])
        where = f"{'RGB'[channel]} of row {row}, column {column} (from the top left)"
        raise Rejected(reason, f"{where} {message}")
