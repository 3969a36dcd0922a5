"""Checks a dataset against its manifest: each checksum, each member, the laws of every sample."""

import itertools
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from storage.dataset.dataset import Dataset, open_dataset, published_manifest
from storage.dataset.layout import shard_names_in
from storage.dataset.manifest import Manifest, ShardEntry, Totals, decode_manifest, is_whole
from storage.dataset.shard import ShardReader
from storage.digests import seal_of, sha256_hex, sha256_of_stream
from storage.errors import EnvironmentFailure, ShardMissing, TrilightError, Unreadable
from storage.licences import mixed_share_alike
from storage.machine import available_cores
from storage.records.lights import part_names, sum_of_lights, sum_of_parts
from storage.records.objects import LockedObject, locked_uids
from storage.records.passes import decode_passes_exr, passes_in_file, picture_passes
from storage.records.sample import Sample, decode_sample
from storage.records.scene import Scene
from storage.remote.store import RemoteStore
from storage.remote.transfers import TransferFailed, download
from storage.typed_json import read_json_lines

REMOTE_THREADS = 8
"""Shards of a server that are fetched, or asked for, at the same time."""

_AHEAD = 256
"""Shards of which findings may wait for those before them."""

MOST_DIFFERENT = 0.02
"""Maximum share of the pixels in which a stored pass may differ from the scene's: on another
processor, a ray at an edge may meet the neighbour. A pass of another camera differs nearly
everywhere."""


@dataclass(frozen=True, kw_only=True)
class Verification:
    """Result of a check of a dataset."""

    manifest: Manifest
    problems: Sequence[str]
    """One line per fault, naming shard and sample; empty where the dataset is whole."""
    bad_shards: Sequence[str]
    """Names of the shards that are missing, or were read and are not what they should be."""
    is_finished: bool
    """True: the manifest lists every shard."""


@dataclass(kw_only=True)
class _ShardFindings:
    """Keys and faults of one shard."""

    faults: list[str] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)


def verify_dataset(
    root: str | Path | Dataset,
    *,
    fast: bool = False,
    shard_done: Callable[[str], None] = lambda name: None,
) -> Verification:
    """Check a dataset, opened or by its path or URL, against its manifest.

    Several shards are checked at once in threads: hashing and unpacking release Python's lock.
    Shards of a server are fetched again, past the cache, and not kept. `shard_done` is called with
    the name of each. With `fast`, only sizes are compared, and in a folder also the headers of the
    members; no picture is read, and a changed byte is not seen.

    It raises TrilightError where there is no readable manifest, so nothing to check against; a
    shard differs from one that was written since; or the disk is full.
    """
    dataset = root if isinstance(root, Dataset) else open_dataset(str(root))
    manifest = dataset.manifest
    lock = dataset.lock_bytes()
    problems = list(_check_lock(lock, dataset))
    rows = [] if problems else read_json_lines(lock or b"", LockedObject, "objects.lock.jsonl")
    locked = None if problems else {row.uid: row for row in rows}
    problems += _check_manifest(dataset)
    names = sorted(shard_names_in(dataset.local.root)) if dataset.local else []
    listed = {shard.name for shard in manifest.shards}
    problems += [f"{name}: not in the manifest" for name in names if name not in listed]
    where: dict[str, str] = {}
    bad: list[str] = []
    threads = available_cores() if dataset.local else REMOTE_THREADS
    with ThreadPoolExecutor(threads) as pool:
        checks = _ahead(
            pool, lambda shard: _check_shard(dataset, shard, locked, fast=fast), manifest.shards
        )
        try:
            for shard, findings in checks:
                faults = findings.faults + [
                    f"sample {key} occurs twice in the dataset, first in {where[key]}"
                    for key in findings.keys
                    if where.setdefault(key, shard.name) != shard.name
                ]
                bad += [shard.name] if faults else []
                problems += [
                    f"{shard.name}: {fault.removeprefix(f'{shard.name}: ')}"
                    for fault in (*faults, *findings.unread)
                ]
                shard_done(shard.name)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    if bad and published_manifest(dataset.store).stored != manifest.stored:
        raise TrilightError(
            f"{dataset.display_name}: its manifest was written while the shards were checked, as "
            "when a dataset grows; expected one that rests. Verify it again."
        )
    return Verification(
        manifest=manifest,
        problems=problems,
        bad_shards=bad,
        is_finished=is_whole(manifest, dataset.num_listed),
    )


def _ahead(
    pool: ThreadPoolExecutor,
    check: Callable[[ShardEntry], _ShardFindings],
    shards: Sequence[ShardEntry],
) -> Iterator[tuple[ShardEntry, _ShardFindings]]:
    """Yield shards in order with what was found, a few of them being checked ahead."""
    submitted = (pool.submit(check, shard) for shard in shards)
    running = deque(itertools.islice(submitted, _AHEAD))
    for shard in shards:
        yield shard, running.popleft().result()
        running.extend(itertools.islice(submitted, 1))


def _check_lock(lock: bytes | None, dataset: Dataset) -> Iterator[str]:
    manifest = dataset.manifest
    if not manifest.objects_lock_sha256:  # a kill may leave it out until the shards are listed
        if dataset.num_listed or (manifest.shards and lock is None):
            yield "objects.lock.jsonl: the manifest has shards but no digest of the lock"
    elif lock is None:
        yield "objects.lock.jsonl: missing"
    elif sha256_hex(lock) != manifest.objects_lock_sha256:
        yield "objects.lock.jsonl: sha256 differs from the manifest"


def _check_manifest(dataset: Dataset) -> Iterator[str]:
    """Yield the faults of the manifest in itself, and of the documents that it vouches for."""
    name = "manifest.json"
    data = dataset.store.get(name) or b""
    listed = decode_manifest(data, name)  # makers may have written it since
    stored = listed.stored
    assert stored is not None  # it was read
    seal = stored.manifest_sha256
    if seal and (seal.encode() not in data or seal_of(data, seal) != seal):
        yield f"{name}: its bytes are not those that were written (manifest_sha256 differs)"
    if stored.dataset_digest != listed.dataset_digest:
        yield (
            f"{name}: dataset_digest is {stored.dataset_digest}; its shards, lock and settings "
            f"have {listed.dataset_digest}"
        )
    sums = Totals(samples=listed.num_samples, bytes=listed.num_bytes)
    if stored.totals not in (None, sums):
        yield f"{name}: totals are {stored.totals}; its shards add up to {sums}"
    for shard, count in Counter(shard.name for shard in listed.shards).items():
        if count > 1:
            yield f"{name}: {shard} is listed {count} times"
    for document, sha256 in listed.documents.items():
        if (content := dataset.store.get(document)) is None:
            yield f"{document}: missing"
        elif sha256_hex(content) != sha256:
            yield f"{document}: edited since it was written (sha256 differs from the manifest)"


def _check_shard(
    dataset: Dataset, shard: ShardEntry, locked: Mapping[str, LockedObject] | None, *, fast: bool
) -> _ShardFindings:
    findings = _ShardFindings()
    try:
        num_bytes = dataset.store.num_bytes(shard.name)
        if num_bytes not in (None, shard.num_bytes):
            findings.faults.append(f"{num_bytes} bytes; expected {shard.num_bytes}")
        if findings.faults or (fast and not dataset.local):
            findings.unread += ["its server states no size"] * (num_bytes is None)
            return findings
        with _open_shard(dataset, shard) as stream:
            opened = ShardReader(stream, shard.name)
            findings.keys = opened.keys
            if (count := len(opened.keys)) != shard.num_samples:
                findings.faults.append(f"{count} samples; expected {shard.num_samples}")
            if not fast:
                stream.seek(0)
                if sha256_of_stream(stream) != shard.sha256:
                    findings.faults.append("sha256 differs from the manifest")
                findings.faults += _check_content(opened, shard, dataset.manifest, locked)
    except EnvironmentFailure:
        raise
    except ShardMissing:
        findings.faults.append("missing")
    except Unreadable as error:
        findings.unread.append(str(error))
    except TransferFailed as error:
        findings.unread.append(f"cannot be read ({error.message})")
    except TrilightError as error:
        findings.faults.append(str(error))
    return findings


def _open_shard(dataset: Dataset, shard: ShardEntry) -> BinaryIO:
    if not isinstance(dataset.store, RemoteStore):
        return dataset.open_stream(shard, checked=False)
    stream: BinaryIO = TemporaryFile()
    try:
        url = dataset.store.url.child(shard.name)
        download(url, stream, num_bytes=shard.num_bytes, max_bytes=shard.num_bytes)
    except BaseException:
        stream.close()
        raise
    return stream


def _check_content(
    opened: ShardReader,
    shard: ShardEntry,
    manifest: Manifest,
    locked: Mapping[str, LockedObject] | None,
) -> Iterator[str]:
    unused = set(opened.maps)
    for key, members in opened:
        unused -= members.keys()
        try:
            sample = decode_sample(key, members)
        except TrilightError as error:
            yield str(error)
        else:
            yield from check_sample(sample, shard.split, manifest, locked)
    yield from (f"map {name} is used by no sample" for name in sorted(unused))


def check_sample(
    sample: Sample, split: str, manifest: Manifest, locked: Mapping[str, LockedObject] | None
) -> list[str]:
    """Return the faults of one sample: laws of the scene, pictures, and rights of its objects."""
    faults = [*_check_pictures(sample, manifest), *_check_rights(sample.scene, split, locked)]
    return [f"sample {sample.key}: {fault}" for fault in faults]


def _check_pictures(sample: Sample, manifest: Manifest) -> Iterator[str]:
    try:
        sample.scene.check()
    except TrilightError as error:
        yield str(error)
    resolution = manifest.setting("renders.resolution", int)
    expected = (manifest.num_views, resolution, resolution, 3)
    if sample.radiance_rgb.shape != expected or sample.scene.num_views != manifest.num_views:
        yield f"pictures {sample.radiance_rgb.shape}; expected {expected}"
    if not (np.isfinite(sample.radiance_rgb).all() and (sample.radiance_rgb >= 0).all()):
        yield "a picture holds a value that is not finite or negative"
    yield from _check_lights(sample, per_light=bool(manifest.setting("renders.per_light", int)))
    split, lobes = (manifest.setting(f"renders.{name}", int) for name in ("split", "split_lobes"))
    yield from _check_parts(sample, part_names(bounces=bool(split), lobes=bool(lobes)))
    yield from _check_passes(sample, manifest.passes)


def _check_rights(
    scene: Scene, split: str, locked: Mapping[str, LockedObject] | None
) -> Iterator[str]:
    if mixed := mixed_share_alike(scene.licences):
        yield f"{' and '.join(mixed)} meet; expected one share-alike licence"
    if locked is None:  # a lock that is wrong says nothing of a sample
        return
    for uid in locked_uids(((row.kind, row.uid) for row in scene.objects), scene.provenance):
        lock = locked.get(uid)
        if lock is None:
            yield f"object {uid!r} is not in objects.lock.jsonl"
        elif lock.split != split:
            yield f"object {uid!r} belongs to split {lock.split}"


def _check_lights(sample: Sample, *, per_light: bool) -> Iterator[str]:
    """Yield the faults of the pictures of single lights; older manifests know no such setting."""
    if (sample.lights_rgb is not None) != per_light:
        verb = "lacks" if per_light else "has"
        yield f"{verb} pictures by light; renders.per_light is {per_light}"
    for view, lights in enumerate(() if sample.lights_rgb is None else sample.lights_rgb):
        floors = sample.views[view].lights
        if floors is not None and len(floors) != len(lights):
            errors = f"{len(floors)} stated errors of lights"
            yield f"view {view} has {errors}; expected {len(lights)}, one for each"
        differs = sum_of_lights(lights) != sample.radiance_rgb[view]
        yield from _differing(f"view {view} is not the sum of its lights", differs)


def _check_parts(sample: Sample, names: tuple[str, ...]) -> Iterator[str]:
    """Yield the faults of the pictures of parts, which the settings name."""
    stored = tuple(sample.parts_rgb or ())
    floors = {tuple(view.parts or ()) for view in sample.views}
    if stored != names or floors != {names}:
        stored_text, expected = (", ".join(each) or "none" for each in (stored, names))
        yield f"parts are {stored_text}; the settings and every view expect {expected}"
    elif sample.parts_rgb is not None:
        whole_rgb = sample.radiance_rgb if sample.lights_rgb is None else sample.lights_rgb
        of_what = "picture" if sample.lights_rgb is None else "light"
        for view, wrong in enumerate(sum_of_parts(sample.parts_rgb) != whole_rgb):
            what = f"view {view} has a {of_what} that is not the sum of its parts"
            yield from _differing(what, wrong.any(axis=0) if wrong.ndim == 4 else wrong)


def _differing(what: str, differs: NDArray[np.bool_]) -> Iterator[str]:
    """Yield a fault where any pixel of [R, R, 3] differs."""
    pixels = np.argwhere(differs.any(axis=-1))
    if len(pixels):
        row, column = (int(index) for index in pixels[0])
        yield f"{what} in {len(pixels)} pixels, first in ({row}, {column})"


def _check_passes(sample: Sample, names: Sequence[str]) -> Iterator[str]:
    """Yield the faults of stored passes; settings without that field ask for none."""
    if bool(names) != (sample.passes_exr is not None):
        yield f"{'lacks' if names else 'has'} passes; storage.passes is {list(names)}"
        return
    resolution = sample.radiance_rgb.shape[2]
    for view, packed in enumerate(sample.passes_exr or ()):
        try:
            stored = decode_passes_exr(packed, resolution)
            computed = picture_passes(sample.scene, [*stored], view=view, resolution=resolution)
        except TrilightError as error:
            yield f"view {view}: {error}"
            continue
        if set(stored) != (expected := set(passes_in_file(sample.scene, names))):
            has = f"view {view} has the passes {', '.join(sorted(stored))}"
            yield f"{has}; expected {', '.join(sorted(expected))}"
        for name, picture in stored.items():
            same = np.isclose(picture, computed[name], rtol=1e-4, atol=1e-4, equal_nan=True)
            share = 1 - float(np.mean(same if same.ndim == 2 else same.all(axis=-1)))
            if share > MOST_DIFFERENT:
                what = f"view {view}: pass {name} is not what the scene says"
                yield f"{what} in {share:.1%} of the pixels"
