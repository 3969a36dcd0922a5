"""Reads finished datasets as sources of others: checks digests, then reads scene by scene."""

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from storage.dataset.dataset import Dataset, open_listed, reading
from storage.dataset.manifest import ShardEntry, is_whole, num_planned
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.objects import locked_uids
from storage.records.profiles import PACKED, PLAIN, unpack_arrays
from storage.records.quantities import QUANTITIES
from storage.records.sample import SceneRecord, decode_scene
from storage.records.scene_facts import scene_values
from storage.remote.url import safe_url


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """Facts that decide whether a scene is selected, and into which shard it goes."""

    dataset: Dataset  # the dataset that holds it
    shard: ShardEntry  # its shard
    key: str  # its key in that shard
    template: str  # layout of the scene
    noise_floor_db: float  # stated error of its worst view, as psnr_log_db
    uids: tuple[str, ...]  # its objects, and the user's textures and map in it
    arrays_sha256: str  # digest of its unpacked arrays: equal for equal scenes
    values: Mapping[str, Any]  # requested values by name (pipeline.shards.expression)


def open_finished(path: str) -> Dataset:
    """Open a finished dataset on this machine.

    Raises:
        TrilightError: the path is a URL, the manifest is unreadable, shards are missing, or the
            lock is not the manifest's.
    """
    if "://" in path:
        raise TrilightError(f"{safe_url(path)}: expected the folder of a dataset on this machine.")
    listed = open_listed(path)
    manifest = listed.manifest
    if not is_whole(manifest, len(manifest.shards)):
        done = {entry.name for entry in manifest.shards}.difference(manifest.growing)
        raise TrilightError(
            f"{path}: {len(done)} of {num_planned(manifest)} shards are there; expected a "
            "finished dataset. Run the same `trilight generate` again to finish it."
        )
    lock = listed.lock_bytes()
    if lock is None or sha256_hex(lock) != manifest.objects_lock_sha256:
        raise TrilightError(
            f"{path}: objects.lock.jsonl is missing or not the one of the manifest (sha256 "
            "differs); run `trilight verify`."
        )
    return listed


def read_facts(
    dataset: Dataset, *, names: Collection[str], shard_done: Callable[[], None]
) -> Iterator[SceneFacts]:
    """Yield the facts of every scene, with the values of some names.

    The digest of each shard is checked first. Memory holds one scene at a time. Pictures are hashed
    with the shard and not decoded.

    Raises:
        TrilightError: a shard is missing or its bytes are not those of the manifest, or the record
            of a scene is incomplete.
    """
    for shard in dataset.manifest.shards:
        with dataset.open_shard(shard, checked=True) as opened:
            for key in opened.samples:
                members = opened.members(key, lambda suffix: suffix in ("json", PLAIN, PACKED))
                values: Mapping[str, Any] = {}
                if names:  # it names the sample itself, which may be whole but not for this process
                    values = condition_values(decode_scene(key, members), shard.split, names)
                with reading(dataset.display_name, f"{shard.name}: sample {key}"):
                    record = json.loads(members["json"])
                    provenance = record["provenance"]
                    rows = ((str(row["kind"]), str(row["uid"])) for row in record["objects"])
                    floors_db = [float(view["noise_floor_db"]) for view in record["views"]]
                    facts = SceneFacts(
                        dataset=dataset,
                        shard=shard,
                        key=key,
                        template=str(provenance.get("template", "unknown")),
                        noise_floor_db=min(floors_db),
                        uids=tuple(locked_uids(rows, provenance)),
                        arrays_sha256=sha256_hex(unpack_arrays(members)),
                        values=values,
                    )
                yield facts
        shard_done()


def condition_values(record: SceneRecord, split: str, names: Collection[str]) -> Mapping[str, Any]:
    """Return the values of a scene for some names (pipeline.shards.expression)."""
    scene = record.scene
    of_scene = dict[str, Any]()
    if not QUANTITIES.keys().isdisjoint(names):
        for name, values in scene_values(record).items():
            plain = [float(value) for value in values]
            of_scene[name] = plain[0] if QUANTITIES[name].per == "scene" else plain
    of_scene |= {
        "key": record.key,
        "split": split,
        "template": str(scene.provenance.get("template", "")),
        "excursion": str((scene.provenance.get("excursion") or {}).get("axis", "")),
        "uid": [entry.uid for entry in scene.objects if entry.kind == "object" or entry.uid],
        "licence": [entry.licence for entry in scene.objects],
        "at_cap": [view.at_cap for view in record.views],
    }
    return {name: of_scene[name] for name in names}
