"""A small dataset made with storage's own writers, whose numbers can be counted by hand.

Every scene has the floor (two triangles, smooth, one material) and the light of the tiny scene, and
per object two flat triangles of two colours, seen by two cameras.

And pages as a browser would read them, with text and rows of objects that mean harm.
"""

import base64
import contextlib
import dataclasses
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from storage.dataset.dataset import Dataset, open_dataset
from storage.dataset.layout import DatasetFolder
from storage.dataset.manifest import Manifest, index_shard, read_manifest, write_manifest
from storage.dataset.shard import write_shard
from storage.errors import TrilightError
from storage.records.asset import AssetRow
from storage.records.objects import Failure, LockedObject, write_failures, write_objects_lock
from storage.records.profiles import Profile
from storage.records.sample import Sample, encode_sample, sample_key
from storage.records.scene import Scene, SceneObject
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE
from tests.scenes_by_hand import tiny_sample, tiny_scene

RED, GREEN = [0.6, 0, 0, 0.1, 0.1, 0.1, 0.3, 0, 0, 0], [0.2, 0.4, 0, 0.1, 0.1, 0.1, 0.3, 0, 0, 0]
SETTINGS = {
    "renders": {"noise_floor_db": 40.0, "min_spp": 64, "max_spp": 256, "resolution": 16},
    "scenes": {"max_triangles": 9},
}


def furnished(uids: Sequence[str], template: str = "plane", **entry: Any) -> Scene:
    """Return the tiny scene with an object per uid; `entry` holds the rights of all of them."""
    scene, count = tiny_scene(), len(uids)
    quad = np.array([[0, 0, 0.1], [1, 0, 0.1], [1, 1, 0.1], [0, 0, 0.1], [1, 1, 0.1], [0, 1, 0.1]])
    added: dict[str, Any] = {
        "vertex_positions": np.tile(quad, (count, 1)),
        "vertex_normals": np.tile([[0, 0, 1]], (6 * count, 1)),
        "faces": 7 + np.arange(6 * count).reshape(-1, 3),
        "material_index": 2 + np.arange(2 * count),
        "materials": np.tile([RED, GREEN], (count, 1)),
        "object_index": 2 + np.repeat(np.arange(count), 2),
    }
    objects = tuple(
        SceneObject(name=f"{row} {uid}", kind="object", uid=uid, **entry)
        for row, uid in enumerate(uids)
    )
    arrays = {name: np.concatenate([getattr(scene, name), rows]) for name, rows in added.items()}
    arrays = {name: rows.astype(getattr(scene, name).dtype) for name, rows in arrays.items()}
    provenance = {**scene.provenance, "template": template}
    return tiny_scene(**arrays, objects=(*scene.objects, *objects), provenance=provenance)


def sample(index: int, scene: Scene, **changes: Any) -> Sample:
    """Return a sample with pictures of noise; `changes` apply to its view records."""
    plain = tiny_sample(sample_key(index), seed=index)
    views = tuple(dataclasses.replace(view, **changes) for view in plain.views)
    return dataclasses.replace(plain, scene=scene, views=views)


def locked(uid: str, licence: str = "CC0-1.0", **changes: str) -> LockedObject:
    plain = {"title": uid.upper(), "attribution": "its maker", "source_url": "", "split": "train"}
    return LockedObject(
        uid=uid, asset_sha256="0" * 64, licence=licence, licence_source="tests", **plain | changes
    )


def write_dataset(
    root: Path,
    shards: Mapping[str, Sequence[Sample]],
    *,
    objects: Sequence[LockedObject] = (),
    failures: Sequence[Failure] = (),
    profiles: Sequence[Profile] = (),
    order: Callable[[Iterable[str]], Iterable[str]] = sorted,
    **changes: Any,
) -> Dataset:
    """Write shards (samples by file name) with all that stands beside them, and open the whole.

    Shards are packed by `profiles`, one for each, or all without loss. `changes` replace fields of
    the manifest, which lists the names of shards in an order.
    """
    folder = DatasetFolder(root)
    for row, (name, samples) in enumerate(shards.items()):
        profile = profiles[row] if profiles else "lossless"
        members = [(entry.key, encode_sample(entry, profile)) for entry in samples]
        write_shard(folder.shard(name), members)
    write_objects_lock(folder.objects_lock, objects)
    write_failures(folder.failures, failures)
    manifest = Manifest(
        build="by-hand",
        settings=SETTINGS,
        environment={"mitsuba_variant": "none"},
        num_scenes=sum(len(samples) for samples in shards.values()),
        num_views=2,
        objects_lock_sha256="",
        shards=tuple(index_shard(folder.shard(name)) for name in order(shards)),
    )
    write_manifest(folder.manifest, dataclasses.replace(manifest, **changes))
    return open_dataset(str(root))


def five_scenes(root: Path) -> Dataset:
    """Return four scenes for training in two shards and one for testing; none for validation."""
    return write_dataset(
        root,
        {
            "train-000000.tar": [
                sample(0, furnished(["a"]), noise_floor_db=38.0, spp=256, at_cap=True),
                sample(1, furnished(["a", "b"], "wall"), noise_floor_db=42.0),
            ],
            "train-000001.tar": [
                sample(2, furnished([])),
                sample(3, furnished(["a", "a"]), camera_attempt=2),
            ],
            "test-000005.tar": [
                sample(20, furnished(["c"], "wall"), noise_floor_db=44.0, coverage=0.5)
            ],
        },
        objects=[locked("a"), locked("b", "CC-BY-4.0"), locked("c", split="test"), locked("d")],
        failures=[
            Failure(stage="scenes", item="000000001", reason="no_room", message="m", attempt=0),
            Failure(stage="scenes", item="000000001", reason="no_room", message="m", attempt=1),
            Failure(stage="renders", item="000000003.1", reason="black_view", message="m"),
            Failure(stage="objects", item="e", reason="no_faces", message="m"),
        ],
    )


def edit_manifest(dataset: Dataset, **changes: Any) -> Path:
    """Change fields of a manifest on disk, digest and totals included, and return its folder."""
    path = dataset.folder.manifest
    record = {**json.loads(path.read_text()), **changes}
    record.pop("manifest_sha256", None)
    path.write_text(json.dumps(record))
    with contextlib.suppress(TrilightError):
        now = read_manifest(path)
        totals = {"samples": now.num_samples, "bytes": now.num_bytes}
        record |= {"dataset_digest": now.dataset_digest, "totals": totals}
        path.write_text(json.dumps(record))
    return dataset.folder.root


def files_of(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder by their names in it."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


HARM = """<script>alert(1)</script><img src=x onerror=alert(2)>"'&"""
RIGHTS = {"licence": HARM, "attribution": HARM, "source_url": "javascript:alert(3)"}
NO_LINKS = {"report": "../report.html", "before": None, "after": None}
"""The links of a scene's page that stands alone."""
VOID = {"meta", "img", "br", "input"}


class Tags(HTMLParser):
    """Collects tags, attributes and text, and checks that tags close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.names: set[str] = set()
        self.ids: set[str] = set()
        self.styles: set[str] = set()
        self.text: list[str] = []
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.names.update(name for name, _ in attrs)
        self.styles.update(value or "" for name, value in attrs if name == "style")
        self.ids.update(value or "" for name, value in attrs if name == "id")
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def text_of(tags: Tags) -> str:
    """Return the text of a page with single spaces."""
    return " ".join(" ".join(tags.text).split())


def read(page: bytes) -> Tags:
    tags = Tags()
    tags.feed(page.decode())
    tags.close()
    assert tags._open == []
    return tags


def pixels_of(link: str) -> NDArray[np.uint8]:
    """Return the picture that a page holds as an address of data."""
    data = base64.b64decode(link.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)))


def row(uid: str = "made/ball", **changes: Any) -> AssetRow:
    plain = AssetRow(
        uid=uid,
        path="meshes/ball.ply",
        title="Ball",
        licence="CC0-1.0",
        licence_source="tests",
        attribution="its maker",
        source_url="https://example.org/ball",
        num_faces=1280,
        method="source",
        quality=QUALITY,
        source=SOURCE,
    )
    return dataclasses.replace(plain, **changes)
