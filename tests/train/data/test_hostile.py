"""Samples that are malformed, out of range or not finite: each costs itself, and is named."""

import dataclasses
import itertools
import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from storage.dataset.shard import write_shard
from storage.dataset.shard_set import OpenShard
from storage.dataset.training_data import open_training_data
from storage.errors import TrilightError
from storage.records.exr import encode_exr
from storage.records.sample import encode_sample
from tests.for_each import for_each
from tests.train.toy import toy_sample
from train.data.order import RankShare
from train.data.stream import StreamSettings, stream_batches
from train.data.unusable import Unusable

SETTINGS = StreamSettings(seed=0, window=2, batch_size=2, resolution=8, views_per_scene=2)
BAD, GOOD = "bad-000000.tar", "good-000000.tar"
Members = dict[str, bytes]


def array(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Members], object]:
    """Return what changes one array of a sample."""

    def spoil(members: Members) -> None:
        arrays = {key: values.copy() for key, values in load(members["scene.safetensors"]).items()}
        replaced = change(arrays[name])
        if isinstance(replaced, np.ndarray):
            arrays[name] = replaced
        members["scene.safetensors"] = save(arrays)

    return spoil


def put(name: str, at: Any, value: float) -> Callable[[Members], object]:
    return array(name, lambda values: values.__setitem__(at, value))


def record(change: Callable[[dict[str, Any]], Any]) -> Callable[[Members], object]:
    """Return what changes the JSON of a sample."""

    def spoil(members: Members) -> None:
        read = json.loads(members["json"])
        change(read)
        members["json"] = json.dumps(read).encode()

    return spoil


def view(field: str, value: Any) -> Callable[[Members], object]:
    return record(lambda read: read["views"][0].__setitem__(field, value))


def nested(members: Members) -> None:
    members["json"] = b'{"schema_version": 3, "x": ' + b"[" * 200_000


def other_picture(members: Members) -> None:
    members["0.exr"] = members["1.exr"] = encode_exr(np.zeros((8, 4, 3), np.float32))


NAN, INF = float("nan"), float("inf")
CASES: dict[str, tuple[Callable[[Members], object], str]] = {
    "deeply nested JSON": (nested, "not JSON"),
    "JSON of another kind": (lambda m: m.update(json=b"[1]"), "schema version None"),
    "no JSON": (lambda m: m.pop("json"), "json is missing"),
    "views are a number": (record(lambda r: r.update(views=3)), "not iterable"),
    "a view too few": (record(lambda r: r["views"].pop()), "1 records of views; expected 2"),
    "an object of another kind": (record(lambda r: r["objects"][0].update(kind="x")), "kind"),
    "an object too few": (record(lambda r: r["objects"].pop()), "object_index.* rows below"),
    "noise floor of text": (view("noise_floor_db", "loud"), "noise_floor_db is 'loud'"),
    "noise floor NaN": (view("noise_floor_db", NAN), "noise_floor_db is nan"),
    "noise floor null": (view("noise_floor_db", None), "noise_floor_db is None"),
    "noise floor far off": (view("noise_floor_db", -1e9), "noise_floor_db is -1000000000"),
    "samples of half a ray": (view("spp", 0.5), "spp is 0.5; expected a whole number"),
    "a field too many": (view("colour", 1), "colour"),
    "vertex NaN": (put("vertex_positions", (0, 1), NAN), r"vertex_positions\[0, 1\] is nan"),
    "vertex infinite": (put("vertex_positions", (2, 0), INF), r"vertex_positions\[2, 0\] is inf"),
    "normal NaN": (put("vertex_normals", (1, 1), NAN), r"vertex_normals\[1, 1\] is nan"),
    "normal too long": (put("vertex_normals", 1, 0.9), "unit length"),
    "material NaN": (put("materials", (0, 0), NAN), r"materials\[0, 0\] is nan"),
    "emission infinite": (put("materials", (0, 8), INF), r"materials\[0, 8\] is inf"),
    "camera NaN": (put("c2w", (0, 0, 0), NAN), r"c2w\[0, 0, 0\] is nan"),
    "camera sheared": (put("c2w", (0, 0, 0), 3.0), "orthonormal"),
    "angle NaN": (put("fov_deg", 0, NAN), r"fov_deg\[0\] is nan"),
    "angle of a half turn": (put("fov_deg", 0, 180.0), r"fov_deg\[0\] is 180"),
    "face out of range": (put("faces", (0, 0), 10**6), r"faces\[0, 0\] is 1000000"),
    "object out of range": (put("object_index", 0, 999), r"object_index\[0\] is 999"),
    "material out of range": (put("material_index", 0, 999), r"material_index\[0\] is 999"),
    "faces are halves": (array("faces", lambda a: a.astype(np.float16)), "dtype float16"),
    "faces of four": (array("faces", lambda a: np.zeros((4, 4), np.uint32)), "shape"),
    "no picture": (lambda m: m.pop("0.exr"), "0.exr.* is missing"),
    "pictures not square": (other_picture, "8 x 4 pixels"),
}


def write_shards(folder: Path, spoil: Callable[[Members], object], bad_samples: int) -> list[str]:
    """Write a shard whose first samples are spoilt and one without fault; return their paths."""
    for name, first, count in ((BAD, 0, 3), (GOOD, 3, 2)):
        samples = []
        for index in range(first, first + count):
            sample = toy_sample(index, resolution=8, views=2)
            members = encode_sample(sample)
            if index < bad_samples:
                spoil(members)
            samples.append((sample.key, members))
        write_shard(folder / name, samples)
    return [f"{folder}/{BAD}", f"{folder}/{GOOD}"]


def keys(paths: list[str], unusable: Unusable, batches: int) -> list[str]:
    stream = stream_batches(
        open_training_data(paths).split("train"),
        SETTINGS,
        0,
        share=RankShare(rank=0, world_size=1),
        workers=1,
        unusable=unusable,
    )
    with closing(stream):
        return [scene.key for batch in itertools.islice(stream, batches) for scene in batch]


@for_each("case", CASES)
def test_a_bad_sample_costs_itself_and_is_named(tmp_path: Path, case: str) -> None:
    spoil, reason = CASES[case]
    paths = write_shards(tmp_path, spoil, bad_samples=1)
    unusable = Unusable(1)
    found = keys(paths, unusable, batches=5)
    assert set(found) == {f"00000000{index}" for index in (1, 2, 3, 4)}
    (message,) = unusable.messages
    assert message.isprintable() and f"/{BAD}: sample 000000000: " in message
    with pytest.raises(TrilightError, match=reason):
        keys(paths, Unusable(0), batches=5)


def test_a_shard_that_is_all_bad_is_given_up_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, _ = CASES["vertex NaN"]
    paths = write_shards(tmp_path, spoil, bad_samples=3)
    tried: list[str] = []
    decode = OpenShard.stored_sample

    def counted(shard: OpenShard, row: int) -> Any:
        tried.append(f"{shard.name}: {shard.keys[row]}")
        return decode(shard, row)

    monkeypatch.setattr(OpenShard, "stored_sample", counted)
    unusable = Unusable(3)
    found = keys(paths, unusable, batches=10)
    assert set(found) == {"000000003", "000000004"}
    assert len(unusable.messages) == 3
    bad = [name for name in tried if BAD in name]
    assert len(bad) == len(set(bad)) == 3


def test_a_scene_with_fewer_views_than_are_drawn_is_replaced(tmp_path: Path) -> None:
    paths = write_shards(tmp_path, lambda members: None, bad_samples=0)
    (tmp_path / GOOD).unlink()
    few = toy_sample(3, resolution=8, views=1)
    write_shard(tmp_path / GOOD, [(few.key, encode_sample(few))])
    unusable = Unusable(1)
    assert few.key not in keys(paths, unusable, batches=5)
    assert "1 views; the run draws 2 of each scene" in unusable.messages[0]


def test_lights_that_are_not_finite_reach_no_weight() -> None:
    sample = toy_sample(0, resolution=8)
    lights = np.stack([sample.radiance_rgb], axis=1)
    dataclasses.replace(sample, lights_rgb=lights).check()
    lights[1, 0, 2, 3, 1] = np.nan
    with pytest.raises(TrilightError, match=r"view 1 light 0 has radiance nan at pixel \(2, 3\)"):
        dataclasses.replace(sample, lights_rgb=lights).check()
