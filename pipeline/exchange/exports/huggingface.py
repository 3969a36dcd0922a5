"""Hugging Face `datasets` export: an image folder for `load_dataset(FOLDER)`.

    SPLIT/metadata.jsonl, SPLIT/KEY.VIEW.{png,depth.tiff,object.tiff,triangle.tiff}

Columns: `image` (8-bit sRGB), `depth` (float32, meters along the axis of the camera, infinite where
nothing is met), `object` and `triangle` (int32 rows of the scene's objects and triangles, -1 where
nothing is met), all as pictures; the camera, the picture's stated error, and the objects' names.
Scenes that stand alone have an RGBA `image`, the columns `normal` and `albedo`, and the stated
error over the object.
https://huggingface.co/docs/datasets/image_dataset
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.documents.png import encode_png
from pipeline.exchange.exports.pictures import (
    stands_alone,
    surface_pictures,
    write_png,
    write_tiff,
)
from storage.atomic import write_atomically
from storage.records.sample import Sample

_PASSES = {"depth": "depth_axis_m", "object": "object", "triangle": "triangle"}
"""Pass of each column."""


def write_huggingface(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write pictures and one table for each split, in the layout of this module."""
    lines: dict[str, list[str]] = {}
    for split, sample in samples:
        for view in range(sample.scene.num_views):
            row = _row(out / split, sample, view)
            lines.setdefault(split, []).append(json.dumps(row, allow_nan=False))
    for split, split_lines in lines.items():
        write_atomically(
            out / split / "metadata.jsonl", "".join(f"{x}\n" for x in split_lines).encode()
        )


def _row(folder: Path, sample: Sample, view: int) -> dict[str, Any]:
    scene = sample.scene
    record = sample.views[view]
    name = f"{sample.key}.{view}"
    alone = stands_alone(scene)
    write_png(folder / f"{name}.png", sample, view, alpha=alone)
    surfaces = surface_pictures(sample, view) if alone else {}
    for column, pixels in surfaces.items():
        write_atomically(folder / f"{name}.{column}.png", encode_png(pixels))
    passes = sample.view_passes(list(_PASSES.values()), view=view)
    for column, pass_name in _PASSES.items():
        write_tiff(folder / f"{name}.{column}.tiff", passes[pass_name])
    return {
        "file_name": f"{name}.png",
        **{f"{column}_file_name": f"{name}.{column}.tiff" for column in _PASSES},
        **{f"{column}_file_name": f"{name}.{column}.png" for column in surfaces},
        "scene": sample.key,
        "view": view,
        "c2w": scene.c2w[view].tolist(),
        "fov_deg": float(scene.fov_deg[view]),
        "noise_floor_db": record.noise_floor_db,
        **({"object_noise_floor_db": record.object_noise_floor_db} if alone else {}),
        "objects": [entry.name for entry in scene.objects],
        "licences": [entry.licence for entry in scene.objects],
    }
