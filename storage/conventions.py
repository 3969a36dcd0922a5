"""Units, frames and colour: what the numbers mean, and the only conversions between meanings.

World: right-handed, +Z up, metres; the nominal shell of a scene is the cube [-0.5, 0.5]^3.
Colour: linear, Rec.709 primaries, scene-referred radiance. Only PNG previews are sRGB-encoded.
Camera: `c2w` [4, 4] maps camera to world; it looks along -Z with +Y up (Blender, OpenGL, USD).
`fov_deg` is the full angle, equal in width and height because pictures are square.
Pictures: row 0 is the top, pixel (i, j) covers the square around its centre (j + 0.5, i + 0.5).
Texture coordinates: u to the right and v up, both repeat. Row 0 of a texture is its BOTTOM: texel
(i, j) of H x W has its centre at u = (j + 0.5) / W, v = (i + 0.5) / H. Readers of pictures, whose
row 0 is the top, turn them over.
Environment maps: latitude-longitude, linear radiance, +Z up; row 0 is the top (+Z), as of a
picture. The centre of the picture is +X, u = 0.25 is +Y, u = 0.75 is -Y, both borders are -X.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from storage.errors import TrilightError

SCHEMA_VERSION = 3
"""Version of everything that Trilight stores and that holds no maps; a change of meaning needs a
new one."""

MAPS_VERSION = 4
"""Version of what holds textures or an environment map: version 3, and those."""

READABLE_VERSIONS = (2, 3, 4)
"""What this code reads. Version 2 is version 3 with the profile `lossless` alone."""

MANIFEST_VERSION = 5
"""Version of the manifest of a dataset, which does not index the members of its shards; those of
versions 2 to 4 do."""

READABLE_MANIFESTS = (*READABLE_VERSIONS, MANIFEST_VERSION)
"""What this code reads."""

SPLITS = ("train", "validation", "test")

HALF_FLOAT_MAX = 65504.0
"""The largest finite value of a stored picture."""


def require_readable(
    version: object, where: str, versions: Sequence[int] = READABLE_VERSIONS
) -> None:
    """Raise TrilightError unless `version` is among `versions`; `where` names the file."""
    if version not in versions:
        *earlier, last = map(str, versions)
        readable = f"{', '.join(earlier)} and {last}"
        raise TrilightError(
            f"{where}: schema version {version!r:.60}; this Trilight reads {readable}. Use the "
            "release that made it, or make it again with `trilight generate`."
        )


def alpha_ggx(roughness: ArrayLike) -> NDArray:
    """Return the GGX width of a roughness: alpha = roughness^2, as in Blender and USD."""
    return np.square(roughness)


ALONG_THE_VIEW = 1e-9
"""Radians between the view and `up` below which the roll would be that of rounding errors."""


def look_at_c2w(*, eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """Return the pose of a camera at `eye` that looks at `target`, float64 [4, 4] camera to world.

    All are [3] in world units; `up` need not be unit or orthogonal. The pose is not finite where
    the view direction is parallel to `up` within ALONG_THE_VIEW, or one of them has no length:
    callers choose other vectors.
    """
    eye64 = np.asarray(eye, np.float64)
    up64 = np.asarray(up, np.float64)
    backward = eye64 - np.asarray(target, np.float64)
    backward = backward / np.linalg.norm(backward)
    right = np.cross(up64, backward)
    across = np.linalg.norm(right)
    right = right / (across if across > ALONG_THE_VIEW * np.linalg.norm(up64) else np.nan)
    c2w = np.eye(4)
    c2w[:3, 0] = right
    c2w[:3, 1] = np.cross(backward, right)
    c2w[:3, 2] = backward
    c2w[:3, 3] = eye64
    return c2w


def focal_px(fov_deg: ArrayLike, resolution: int) -> NDArray[np.float64]:
    """Return the focal length in pixels of a square picture `resolution` pixels wide."""
    return 0.5 * resolution / np.tan(np.radians(fov_deg, dtype=np.float64) / 2)


def camera_rays(
    c2w: ArrayLike, fov_deg: float, resolution: int, rows: slice = slice(None)
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rays through the pixel centres of one camera, in world space.

    Args:
        c2w: [4, 4].
        fov_deg: full field of view in degrees.
        resolution: width and height in pixels.
        rows: of the picture; all by default.

    Returns:
        origin [3] and unit directions [rows, resolution, 3] (row 0 on top), float64.
    """
    pose = np.asarray(c2w, np.float64)
    offset = np.arange(resolution) + 0.5 - 0.5 * resolution
    x, y = np.meshgrid(offset, -offset[rows])
    local = np.stack([x, y, np.full_like(x, -focal_px(fov_deg, resolution))], axis=-1)
    directions = local @ pose[:3, :3].T
    return pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def in_camera(positions: ArrayLike, c2w: ArrayLike) -> NDArray[np.float64]:
    """Return world positions [..., 3] in the axes of a camera, which looks along -Z, in metres."""
    pose = np.asarray(c2w, np.float64)
    offset = np.asarray(positions, np.float64) - pose[:3, 3]
    return offset @ np.linalg.inv(pose[:3, :3]).T


def pixel_places(
    positions: ArrayLike, c2w: ArrayLike, fov_deg: float, resolution: int
) -> NDArray[np.float64]:
    """Return where a camera's picture shows world positions: the inverse of `camera_rays`.

    Args:
        positions: [..., 3] in metres.
        c2w: [4, 4].
        fov_deg: full field of view in degrees.
        resolution: width and height in pixels.

    Places are x from the left and y from the top [..., 2] in pixels, float64; the centre of pixel
    (i, j) is (j + 0.5, i + 0.5). They may lie outside the picture; what is not before the camera
    has NaN.
    """
    local = in_camera(positions, c2w)
    with np.errstate(invalid="ignore"):
        depth = np.where(local[..., 2] < 0, -local[..., 2], np.nan)
    scale = focal_px(fov_deg, resolution) / depth
    return 0.5 * resolution + np.stack([local[..., 0], -local[..., 1]], axis=-1) * scale[..., None]


def latlong_uv(directions: ArrayLike) -> NDArray[np.float64]:
    """Return where an environment map holds directions: the inverse of `latlong_direction`.

    Args:
        directions: [..., 3] in the axes of the map, of any length but 0.

    Returns:
        u and v [..., 2] in [0, 1], float64; v is up, as everywhere: 1 at +Z, in the top row. At
        the poles u is 0.5, or what rounding makes of it.
    """
    # by a function of numpy's, which tensors in its place answer too (model.hits.device_arrays)
    x, y, z = np.moveaxis(np.positive(directions, dtype=np.float64), -1, 0)
    u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
    # of the two arcs, not of z alone: near the poles the arc cosine loses half of its digits
    v = 1 - np.arctan2(np.hypot(x, y), z) / np.pi
    return np.stack([u, v], axis=-1)


def latlong_direction(uv: ArrayLike) -> NDArray[np.float64]:
    """Return the unit directions [..., 3] that an environment map holds at u and v [..., 2]."""
    u, v = np.moveaxis(np.asarray(uv, np.float64), -1, 0)
    azimuth = (0.5 - u) * 2 * np.pi
    polar = (1 - v) * np.pi
    flat = np.sin(polar)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(polar)], axis=-1)


def log10_radiance(radiance_rgb: ArrayLike) -> NDArray:
    """Return log10(1 + radiance), the space of the network's output and of the stated error."""
    return np.log10(1.0 + np.asarray(radiance_rgb))


def radiance_from_log10(log10_rgb: ArrayLike) -> NDArray:
    """Return the radiance of values in the network's output space."""
    return np.power(10.0, np.asarray(log10_rgb)) - 1.0


def srgb8(linear: ArrayLike) -> NDArray[np.uint8]:
    """Return linear values as sRGB in 8 bits, clamped to [0, 1]: an albedo as a screen shows it."""
    clamped = np.clip(np.asarray(linear, np.float64), 0, 1)
    encoded = np.where(clamped <= 0.0031308, 12.92 * clamped, 1.055 * clamped ** (1 / 2.4) - 0.055)
    return np.round(encoded * 255).astype(np.uint8)


def linear_from_srgb(encoded: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the linear values of sRGB-encoded ones in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_from_srgb8() -> NDArray[np.float32]:
    """Return the linear value [256] of every 8-bit sRGB value: the inverse of `srgb8`."""
    return linear_from_srgb(np.arange(256) / 255).astype(np.float32)


def preview_srgb8(radiance_rgb: ArrayLike) -> NDArray[np.uint8]:
    """Return a picture for people: log2(1 + radiance) clamped to [0, 1], sRGB-encoded, 8 bits.

    The curve is the tone map of RenderFormer's perceptual loss (Zeng et al. 2025, section 4), so
    what a person sees is what the loss sees. It is not invertible: values above 1 are clipped.
    """
    return srgb8(np.log2(1.0 + np.maximum(np.asarray(radiance_rgb, np.float64), 0)))


def preview_gain(radiance_rgb: NDArray[np.float32]) -> np.float32:
    """Return the factor that shows all pictures [..., 3] of a scene darker; 1 for most scenes.

    At most a twentieth of the pixels is white then. What is stored or measured knows none.
    """
    return np.float32(1 / max(1.0, np.percentile(radiance_rgb.max(axis=-1), 95)))
