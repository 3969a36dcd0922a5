"""nerfstudio export: one folder for each scene, with `transforms.json`, pictures and depths.

    KEY/transforms.json, KEY/images/VIEW.png, KEY/depths/VIEW.npy
    KEY/{normals,albedos}/VIEW.png    of a scene that stands alone, whose images are RGBA

Poses are camera to world, looking along -Z with +Y up, world +Z up. Depths are along the axis of
the camera, in millimeters, since nerfstudio multiplies them by 0.001; 0 is unknown.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.documents.png import encode_png
from pipeline.exchange.exports.pictures import (
    stands_alone,
    surface_pictures,
    write_json,
    write_png,
)
from storage.atomic import write_atomically
from storage.conventions import focal_px
from storage.records.sample import Sample

_MM = np.float32(1000)


def write_nerfstudio(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write one folder for each sample, in the layout of this module."""
    for _, sample in samples:
        folder = out / sample.key
        frames = [_frame(folder, sample, view) for view in range(sample.scene.num_views)]
        write_json(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames})


def _frame(folder: Path, sample: Sample, view: int) -> dict[str, Any]:
    scene = sample.scene
    resolution = sample.radiance_rgb.shape[2]
    depth = sample.view_passes(["depth_axis_m"], view=view)["depth_axis_m"]
    stream = io.BytesIO()
    np.save(stream, np.where(np.isfinite(depth), depth * _MM, np.float32(0)))
    write_atomically(folder / f"depths/{view}.npy", stream.getvalue())
    alone = stands_alone(scene)
    write_png(folder / f"images/{view}.png", sample, view, alpha=alone)
    surfaces = surface_pictures(sample, view) if alone else {}
    for name, pixels in surfaces.items():
        write_atomically(folder / f"{name}s/{view}.png", encode_png(pixels))
    focal = float(focal_px(float(scene.fov_deg[view]), resolution))
    return {
        "file_path": f"images/{view}.png",
        "depth_file_path": f"depths/{view}.npy",
        "transform_matrix": scene.c2w[view].tolist(),
        "fl_x": focal,
        "fl_y": focal,
        "cx": resolution / 2,
        "cy": resolution / 2,
        "w": resolution,
        "h": resolution,
        **{f"{name}_file_path": f"{name}s/{view}.png" for name in surfaces},
    }
