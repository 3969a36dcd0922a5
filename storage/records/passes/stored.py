"""Passes as OpenEXR, as a sample may hold them and `trilight passes` writes them.

All channels are float32, packed without loss: ids below 2^24 are exact in it, and Nuke and Blender
turn every channel into it anyway. Names of channels are `Pass.exr_channels`. The channel A, which
is the pass `coverage`, is always there. Where it is 0 nothing is met, and the file holds 0 instead
of NaN, since filters of other programs would spread NaN over its neighbours; readers restore it.
For the same reason a scene without textures has no channels of the pass `uv`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from storage.errors import TrilightError
from storage.records.exr import channel_names, decode_channels, encode_channels
from storage.records.passes.declared import UV, Pass, declared_passes
from storage.records.passes.pictures import view_passes
from storage.records.scene import Scene

COVERAGE = "coverage"
"""The pass that every file has."""

MOST_IDS = 2**24
"""Float32 holds every whole number up to this one."""


def passes_exr(
    scene: Scene, names: Sequence[str], *, view: int, resolution: int, rays_a_side: int = 1
) -> bytes:
    """Return the OpenEXR file of passes of one camera; equal arguments give equal bytes.

    Args:
        scene: passes `Scene.check`.
        names: of the passes; `passes_in_file` says which of them the file has.
        view, resolution, rays_a_side: as `view_passes`.

    Raises:
        TrilightError: as `view_passes`, or the scene has more than 2^24 triangles.
    """
    if scene.num_triangles > MOST_IDS:
        raise TrilightError(
            f"passes: the scene has {scene.num_triangles} triangles; expected at most {MOST_IDS}, "
            "so that ids are exact in a file."
        )
    pictures = view_passes(
        scene,
        passes_in_file(scene, names),
        view=view,
        resolution=resolution,
        rays_a_side=rays_a_side,
    )
    is_hit = pictures[COVERAGE] > 0
    channels: dict[str, NDArray[np.float32]] = {}
    for each in _passes(pictures):
        values = np.atleast_3d(pictures[each.name]).astype(np.float32)
        unmet = np.isnan(values) & ~is_hit[..., None]
        planes = np.where(unmet, np.float32(0), values)
        for number, channel in enumerate(each.exr_channels):
            channels[channel] = np.ascontiguousarray(planes[..., number])
    return encode_channels(channels)


def decode_passes_exr(data: bytes, resolution: int) -> dict[str, NDArray]:
    """Return the passes in a file by name, as `picture_passes`; `coverage` is among them.

    Raises:
        TrilightError: not an EXR file, truncated, of another size, or with channels that are no
            whole passes.
    """
    stored_channels = set(channel_names(data))
    passes = [each for each in declared_passes() if stored_channels >= set(each.exr_channels)]
    names = [channel for each in passes for channel in each.exr_channels]
    if COVERAGE not in {each.name for each in passes}:
        raise TrilightError("passes: channel A (coverage) is missing.")
    size = (resolution, resolution)
    channels = decode_channels(data, names, size=size, what="passes", separate=True)
    nowhere = channels["A"] == 0
    return {each.name: _restore(each, channels, nowhere) for each in passes}


def picture_passes(
    scene: Scene, names: Sequence[str], *, view: int, resolution: int, stored: bytes | None = None
) -> dict[str, NDArray]:
    """Return passes of one view by name, one ray a pixel: the same numbers, stored or computed.

    Args:
        scene, names, view, resolution: as `view_passes`.
        stored: an OpenEXR file of passes of this view; what it lacks is computed.

    Returns:
        as `view_passes`, with float32 in place of float64.

    Raises:
        TrilightError: as `view_passes` and `decode_passes_exr`.
    """
    pictures = {} if stored is None else decode_passes_exr(stored, resolution)
    lacking = [name for name in names if name not in pictures]
    if lacking:
        computed = view_passes(scene, lacking, view=view, resolution=resolution)
        pictures |= {
            each.name: computed[each.name].astype(_stored_dtype(each)) for each in _passes(computed)
        }
    return {name: pictures[name] for name in names}


def passes_in_file(scene: Scene, names: Sequence[str]) -> list[str]:
    """Return the passes that a file has where `names` are asked for.

    `coverage` is among them; `uv` only where the scene has texture coordinates, so that of a preset
    which mixes textured and plain scenes no file holds NaN where a surface is met.
    """
    known = [name for name in names if name != UV or scene.uv is not None]
    return known if COVERAGE in known else [*known, COVERAGE]


def _passes(pictures: Mapping[str, NDArray]) -> list[Pass]:
    return [each for each in declared_passes() if each.name in pictures]


def _stored_dtype(each: Pass) -> type:
    """Return the type of a pass that went through a file."""
    return np.float32 if each.dtype is np.float64 else each.dtype


def _restore(each: Pass, channels: Mapping[str, NDArray], nowhere: NDArray[np.bool_]) -> NDArray:
    planes = [np.asarray(channels[channel], np.float32) for channel in each.exr_channels]
    if np.isnan(each.nothing):
        unmet = nowhere & np.all([plane == 0 for plane in planes], axis=0)
        planes = [np.where(unmet, np.float32(np.nan), plane) for plane in planes]
    picture = np.stack(planes, axis=-1) if each.channels else planes[0]
    return picture.astype(_stored_dtype(each))
