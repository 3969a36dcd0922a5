"""Frozen catalogues of any size: a lock and an index of many rows over a few real assets."""

import dataclasses
import hashlib
import itertools
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from storage.digests import canonical_json, sha256_hex
from storage.installation import IMPORT_ROOT, module_name
from storage.records.object_index import IndexedObject, write_object_index
from storage.records.objects import LockedObject

NUM_REAL = 8
"""Assets that all rows share."""


def write_catalogue(folder: Path, assets: Sequence[tuple[str, str, int]], count: int) -> None:
    """Write `objects.lock.jsonl` and `objects.index` of so many training objects.

    Args:
        folder: where.
        assets: name in the store, digest and least triangles of each real asset.
        count: rows; each is of one of the assets in turn.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock, offset, digest = folder / "objects.lock.jsonl", 0, hashlib.sha256()
    indexed = []
    with lock.open("wb") as stream:
        for row, (name, sha256, least) in zip(_rows(count), itertools.cycle(assets), strict=False):
            locked = dataclasses.replace(row, asset_sha256=sha256)
            record = dataclasses.asdict(locked)
            del record["kind"]
            line = canonical_json(record) + b"\n"
            stream.write(line)
            digest.update(line)
            indexed.append(
                IndexedObject(locked=locked, offset=offset, asset_name=name, least_triangles=least)
            )
            offset += len(line)
    write_object_index(
        folder / "objects.index",
        indexed,
        lock_sha256=digest.hexdigest(),
        lock_bytes=offset,
        asked=sha256_hex(b"many"),
        num_found=count,
    )


def _rows(count: int) -> Iterator[LockedObject]:
    for number in range(count):
        yield LockedObject(
            uid=f"many/{number:09d}",
            asset_sha256="",
            split="train",
            licence=("CC0-1.0", "CC-BY-4.0", "CC-BY-SA-4.0")[number % 3],
            licence_source="Objaverse 1.0 annotations, as of 2022-12-15",
            title=f"Object number {number}",
            attribution=f"Somebody {number % 9973}",
            source_url=f"https://example.org/3d-models/{number:032x}",
        )


def draw_in_child(folder: Path, store: Path, scenes: int) -> dict[str, float]:
    """Draw scenes' objects in a fresh process; returns its memory and times.

    `held_bytes` is what the process grows by, `open_s` the time to open the catalogue, `draw_s`
    and `tight_s` those of a scene of three objects: all fit, or the largest do not.
    """
    modules = ["pipeline.making.frozen_pool", "pipeline.assets.store", "pipeline.scenes.fitting"]
    command = [sys.executable, "-c", _CHILD, str(folder), str(store), str(scenes)]
    command += [module_name(name) for name in modules]
    ran = subprocess.run(command, cwd=IMPORT_ROOT, capture_output=True, text=True, check=True)
    held, open_s, draw_s, tight_s = map(float, ran.stdout.split())
    return {"held_bytes": held, "open_s": open_s, "draw_s": draw_s, "tight_s": tight_s}


_CHILD = """
import sys, time
from importlib import import_module
from pathlib import Path
import numpy as np
folder, store, scenes = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
pools, stores, fitting = map(import_module, sys.argv[4:])
def held():
    lines = open("/proc/self/status").read().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
frozen = pools.FrozenPool(lock=folder / "objects.lock.jsonl", index=folder / "objects.index",
                          source="", licence=None)
before, began = held(), time.perf_counter()
pool = frozen.opened("train", stores.AssetStore(store))
opened = time.perf_counter() - began
def draw(room):
    began = time.process_time()
    for scene in range(scenes):
        for row in fitting.drawn_rows(np.random.default_rng(scene), pool.fits, 3, room):
            pool[row]
    return (time.process_time() - began) / scenes
most = max(sizes.most for sizes in pool.fits.sizes.values())
least = min(sizes.least for sizes in pool.fits.sizes.values())
all_fit, tight = draw(3 * most), draw(2 * least + max(least, most - 1))
print(held() - before, opened, all_fit, tight)
"""
