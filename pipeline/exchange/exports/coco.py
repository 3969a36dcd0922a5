"""COCO: masks and boxes of the objects and shell parts that each picture shows.

    SPLIT/KEY.VIEW.png, annotations/instances_SPLIT.json

Masks are exact: the pixels whose centre shows the object, run-length encoded column by column.
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
"""Ids of categories by kind; emitters are hidden from cameras."""


def write_coco(samples: Iterator[tuple[str, Sample]], out: Path) -> None:
    """Write the pictures, and one file of annotations for each split; see the top of this file."""
    splits: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for split, sample in samples:
        found = splits.setdefault(split, {"images": [], "annotations": []})
        for view in range(sample.scene.num_views):
            name = f"{sample.key}.{view}.png"
            write_png(out / split / name, sample, view)
            size = sample.radiance_rgb.shape[2]
            image_id = len(found["images"]) + 1
            found["images"].append(
                {"id": image_id, "file_name": name, "width": size, "height": size}
            )
            ids = sample.view_passes(["object"], view=view)["object"]
            for annotation in _annotations(ids, sample.scene.objects):
                number = len(found["annotations"]) + 1
                found["annotations"].append({"id": number, "image_id": image_id, **annotation})
    categories = [{"id": number, "name": kind} for kind, number in _CATEGORIES.items()]
    for split, found in splits.items():
        path = out / f"annotations/instances_{split}.json"
        write_json(path, {"info": {}, "licenses": [], "categories": categories, **found})


def _annotations(
    ids: NDArray[np.int32], objects: Sequence[SceneObject]
) -> Iterator[dict[str, Any]]:
    """Yield an annotation for each row of `objects` among the ids [R, R] of a picture."""
    for row in np.unique(ids[ids >= 0]).tolist():
        shown, mask = objects[row], ids == row
        rows, columns = np.nonzero(mask)
        left, top = int(columns.min()), int(rows.min())
        yield {
            "category_id": _CATEGORIES[shown.kind],
            "segmentation": {"size": list(mask.shape), "counts": _runs(mask)},
            "area": len(rows),
            "bbox": [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1],
            "iscrowd": 0,
            "object_name": shown.name,
            "uid": shown.uid,
            "licence": shown.licence,
            "attribution": shown.attribution,
        }


def _runs(mask: NDArray[np.bool_]) -> list[int]:
    """Return the lengths of runs of 0, 1, 0, ... in a mask, column by column."""
    flat = mask.T.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths: list[int] = np.diff(np.concatenate([[0], changes, [len(flat)]])).tolist()
    return [0, *lengths] if flat[0] else lengths
