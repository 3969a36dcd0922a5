"""Is a dataset what its manifest says? Every hash, member and law, and a list of what is wrong."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.layout import DatasetFolder
from storage.licences import mixed_share_alike
from storage.lights import sum_of_lights
from storage.manifest import Manifest, ShardEntry, index_shard, read_manifest
from storage.objects_lock import read_objects_lock
from storage.records import LockedObject
from storage.sample import Sample, decode_sample
from storage.shard_reader import iterate_samples


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What a check of a dataset found."""

    manifest: Manifest
    """The manifest that was checked."""
    problems: Sequence[str]
    """One line per fault, naming shard and sample; empty where the dataset is whole."""
    num_samples: int
    """Samples that were looked at."""


def verify_dataset(
    root: Path, *, fast: bool = False, shard_done: Callable[[str], None] = lambda name: None
) -> Verification:
    """Check a dataset folder against its manifest.

    Args:
        root: the dataset.
        fast: compare only sizes and member counts, reading no picture.
        shard_done: called with the name of each shard that was looked at.

    Raises:
        TrilightError: there is no readable manifest, so there is nothing to check against.
    """
    folder = DatasetFolder(root)
    manifest = read_manifest(folder.manifest)
    problems = list(_check_lock(folder, manifest))
    locked = _locked_by_uid(folder) if not problems else {}
    listed = {shard.name for shard in manifest.shards}
    problems += [
        f"{name}: not in the manifest"
        for path in folder.shard_files()
        if (name := path.relative_to(root).as_posix()) not in listed
    ]
    num_samples, keys = 0, set[str]()
    for shard in manifest.shards:
        for fault in _check_shard(folder, shard, manifest, locked, keys, fast=fast):
            problems.append(f"{shard.name}: {fault}")
        num_samples += shard.num_samples
        shard_done(shard.name)
    return Verification(manifest=manifest, problems=problems, num_samples=num_samples)


def _locked_by_uid(folder: DatasetFolder) -> dict[str, LockedObject]:
    if not folder.objects_lock.exists():
        return {}
    return {entry.uid: entry for entry in read_objects_lock(folder.objects_lock)}


def _check_lock(folder: DatasetFolder, manifest: Manifest) -> Iterator[str]:
    path = folder.objects_lock
    if not manifest.objects_lock_sha256:
        if manifest.shards:
            yield "objects.lock.jsonl: the manifest has shards but no digest of the lock"
    elif not path.exists():
        yield "objects.lock.jsonl: missing"
    elif sha256_hex(path.read_bytes()) != manifest.objects_lock_sha256:
        yield "objects.lock.jsonl: sha256 differs from the manifest"


def _check_shard(
    folder: DatasetFolder,
    shard: ShardEntry,
    manifest: Manifest,
    locked: dict[str, LockedObject],
    keys: set[str],
    *,
    fast: bool,
) -> Iterator[str]:
    path = folder.shard(shard.name)
    if not path.exists():
        yield "missing"
        return
    if path.stat().st_size != shard.num_bytes:
        yield f"{path.stat().st_size} bytes; expected {shard.num_bytes}"
        return
    if fast:
        return
    try:
        if index_shard(path) != shard:
            yield "sha256 or member index differs from the manifest"
        for key, members in iterate_samples(path):
            if key in keys:
                yield f"sample {key} occurs twice in the dataset"
            keys.add(key)
            yield from check_sample(decode_sample(key, members), shard.split, manifest, locked)
    except TrilightError as error:
        yield str(error)


def check_sample(
    sample: Sample, split: str, manifest: Manifest, locked: dict[str, LockedObject]
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
