"""Writers of PNG, TIFF and JSON files for the exports.

A scene stands alone where nothing is behind its objects: no floor, no wall, no sky that cameras
see. Its pictures get alpha, and pictures of normals and albedo beside them.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipeline.documents.png import encode_png
from storage.atomic import write_atomically
from storage.conventions import preview_srgb8, srgb8
from storage.records.passes.pictures import view_passes
from storage.records.sample import Sample
from storage.records.scene import Scene

_ALPHA_RAYS = 4
"""Rays along each side of a pixel that tell its alpha."""


def stands_alone(scene: Scene) -> bool:
    """Return whether nothing is behind the objects of a scene."""
    sky = scene.environment
    has_shell = any(entry.kind == "shell" for entry in scene.objects)
    return not has_shell and not (sky is not None and sky.is_seen)


def write_png(path: Path, sample: Sample, view: int, *, alpha: bool = False) -> None:
    """Write the picture of a view as 8-bit sRGB; radiance above 1 is clipped.

    Args:
        path: the file.
        sample: whose picture.
        view: row of the cameras.
        alpha: write RGBA, of a scene that stands alone. Colors are straight: those of the surface
            alone, without the black around it. Alpha is the share of 16 rays that meet a surface.
    """
    radiance_rgb = sample.radiance_rgb[view]
    if not alpha:
        write_atomically(path, encode_png(preview_srgb8(radiance_rgb)))
        return
    resolution = len(radiance_rgb)
    seen = view_passes(
        sample.scene, ["coverage"], view=view, resolution=resolution, rays_a_side=_ALPHA_RAYS
    )["coverage"]
    surface_rgb = radiance_rgb / np.where(seen > 0, seen, 1)[..., None]
    alpha8 = np.round(255 * seen[..., None]).astype(np.uint8)
    rgba = np.concatenate([preview_srgb8(surface_rgb), alpha8], axis=-1)
    write_atomically(path, encode_png(np.where(alpha8 > 0, rgba, 0).astype(np.uint8)))


def surface_pictures(sample: Sample, view: int) -> dict[str, NDArray[np.uint8]]:
    """Return 8-bit pictures [R, R, 3] of what a view's surfaces are, black where there is none.

    `normal`: the shading normal in world axes, -1 to 1 as 0 to 255. `albedo`: diffuse and specular
    albedo together, sRGB-encoded.
    """
    names = ["shading_normal", "material_diffuse", "material_specular"]
    normal, diffuse, specular = sample.view_passes(names, view=view).values()
    rgb8 = np.nan_to_num(np.round((normal + 1) * 127.5)).astype(np.uint8)
    return {"normal": rgb8, "albedo": srgb8(np.nan_to_num(diffuse + specular))}


def write_tiff(path: Path, values: NDArray[np.float32] | NDArray[np.int32]) -> None:
    """Write one value for each pixel [R, R] as a lossless 32-bit TIFF."""
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "TIFF")
    write_atomically(path, stream.getvalue())


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file and keep the order of its keys."""
    write_atomically(path, (json.dumps(value, allow_nan=False) + "\n").encode())
