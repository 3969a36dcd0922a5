"""COCO export: masks and boxes of the visible objects and shells of each picture.

    SPLIT/KEY.VIEW.png, annotations/instances_SPLIT.json

Masks are exact: pixels whose center shows the object, run-length encoded column by column.
https://cocodataset.org/#format-data
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.exchange.exports.pictures import write_json, write_png
from storage.records.sample import Sample
from storage.records.scene import SceneObject

_CATEGORIES = {"object": 1, "shell": 2}
"""Category ids by kind of object; emitters are hidden from cameras."""


def write_coco(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write pictures and one annotation file for each split, in the layout of this module."""
    splits: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for split, sample in samples:
        tables = splits.setdefault(split, {"images": [], "annotations": []})
        for view in range(sample.scene.num_views):
            name = f"{sample.key}.{view}.png"
            write_png(out / split / name, sample, view)
            size = sample.radiance_rgb.shape[2]
            image_id = len(tables["images"]) + 1
            tables["images"].append(
                {"id": image_id, "file_name": name, "width": size, "height": size}
            )
            ids = sample.view_passes(["object"], view=view)["object"]
            for annotation in _annotations(ids, sample.scene.objects):
                number = len(tables["annotations"]) + 1
                tables["annotations"].append({"id": number, "image_id": image_id, **annotation})
    categories = [{"id": number, "name": kind} for kind, number in _CATEGORIES.items()]
    for split, tables in splits.items():
        path = out / f"annotations/instances_{split}.json"
        write_json(path, {"info": {}, "licenses": [], "categories": categories, **tables})


def _annotations(
    ids: NDArray[np.int32], objects: Sequence[SceneObject]
) -> Iterator[dict[str, Any]]:
    """Yield an annotation for each row of `objects` among the ids [R, R] of a picture."""
    for row in np.unique(ids[ids >= 0]).tolist():
        entry = objects[row]
        mask = ids == row
        corners = np.argwhere(mask)[:, ::-1]
        low = corners.min(axis=0)
        size = corners.max(axis=0) - low + 1
        yield {
            "category_id": _CATEGORIES[entry.kind],
            "segmentation": {"size": list(mask.shape), "counts": _runs(mask)},
            "area": len(corners),
            "bbox": [*low.tolist(), *size.tolist()],
            "iscrowd": 0,
            "object_name": entry.name,
            "uid": entry.uid,
            "licence": entry.licence,
            "attribution": entry.attribution,
        }


def _runs(mask: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of runs of 0, 1, 0, ... in a mask, column by column."""
    flat = mask.T.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths: list[int] = np.diff(np.concatenate([[0], changes, [len(flat)]])).tolist()
    return [0, *lengths] if flat[0] else lengths
