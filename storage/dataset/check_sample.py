"""The laws of one sample of a dataset: scene, pictures, lights, and rights of its objects."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from storage.dataset.manifest import Manifest
from storage.errors import TrilightError
from storage.licences import mixed_share_alike
from storage.records.lights import sum_of_lights
from storage.records.objects import LockedObject
from storage.records.sample import Sample


def check_sample(
    sample: Sample, split: str, manifest: Manifest, locked: Mapping[str, LockedObject]
) -> Iterator[str]:
    """Yield the faults of one sample: laws of the scene, pictures, and rights of its objects."""
    try:
        sample.scene.check()
    except TrilightError as error:
        yield f"sample {sample.key}: {error}"
    resolution = _setting(manifest, "renders", "resolution")
    expected = (manifest.num_views, resolution, resolution, 3)
    if sample.radiance_rgb.shape != expected or sample.scene.num_views != manifest.num_views:
        yield f"sample {sample.key}: pictures {sample.radiance_rgb.shape}; expected {expected}"
    if not (np.isfinite(sample.radiance_rgb).all() and (sample.radiance_rgb >= 0).all()):
        yield f"sample {sample.key}: a picture holds a value that is not finite or negative"
    yield from _check_lights(sample, apart=bool(manifest.settings["renders"].get("per_light")))
    if mixed := mixed_share_alike(entry.licence for entry in sample.scene.objects):
        yield f"sample {sample.key}: {' and '.join(mixed)} meet; expected one share-alike licence"
    for entry in sample.scene.objects:
        if entry.kind != "object":
            continue
        lock = locked.get(entry.uid)
        if lock is None:
            yield f"sample {sample.key}: object {entry.uid!r} is not in objects.lock.jsonl"
        elif lock.split != split:
            yield f"sample {sample.key}: object {entry.uid!r} belongs to split {lock.split}"


def _check_lights(sample: Sample, *, apart: bool) -> Iterator[str]:
    """Yield the faults of the pictures of single lights; older manifests know no such setting."""
    if (sample.lights_rgb is not None) != apart:
        found = "lacks" if apart else "has"
        yield f"sample {sample.key}: {found} pictures by light; renders.per_light is {apart}"
    if sample.lights_rgb is None:
        return
    for view, lights in enumerate(sample.lights_rgb):
        differs = (sum_of_lights(lights) != sample.radiance_rgb[view]).any(axis=-1)
        if differs.any():
            row, column = (int(index) for index in np.argwhere(differs)[0])
            yield (
                f"sample {sample.key}: view {view} is not the sum of its lights in "
                f"{int(differs.sum())} pixels, first in ({row}, {column})"
            )


def _setting(manifest: Manifest, group: str, name: str) -> Any:
    return manifest.settings[group][name]
