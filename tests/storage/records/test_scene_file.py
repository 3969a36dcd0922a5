"""Scene and asset files come back exactly; what is none is refused before it takes memory."""

import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from safetensors.numpy import save

from pipeline.objects.ply import encode_ply
from storage.digests import sha256_hex
from storage.errors import TrilightError
from storage.records.asset import Asset, Level, LevelRecord, decode_asset, encode_asset
from storage.records.sample import encode_sample
from storage.records.scene import ARRAY_FIELDS, SceneObject
from storage.records.scene_file import (
    MAX_FILE_BYTES,
    decode_scene_file,
    encode_scene,
    read_scene_file,
    scene_digest,
)
from tests.for_each import case, for_each
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE
from tests.scenes_by_hand import tiny_sample, tiny_scene

KEY = "trilight_scene"


def _metadata() -> dict[str, Any]:
    """Return what the file of the tiny scene says beside its arrays."""
    data = encode_scene(tiny_scene())
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    found: dict[str, Any] = json.loads(header["__metadata__"][KEY])
    return found


def _stating(metadata: dict[str, Any]) -> bytes:
    """Return the file of the tiny scene with other metadata."""
    arrays = {name: getattr(tiny_scene(), name) for name in ARRAY_FIELDS}
    return save(arrays, {KEY: json.dumps(metadata)})


def test_round_trip_is_exact() -> None:
    odd = SceneObject(
        name='floor "ü" \n', kind="shell", licence="MIT", attribution="Ö", source_url="x"
    )
    scene = tiny_scene(objects=(odd, SceneObject(name="light", kind="emitter")))
    back = decode_scene_file(encode_scene(scene), "a")
    for name, (dtype, _) in ARRAY_FIELDS.items():
        assert getattr(back, name).dtype == dtype
        assert np.array_equal(getattr(back, name), getattr(scene, name))
    assert back.objects == scene.objects
    assert back.provenance == scene.provenance
    assert encode_scene(back) == encode_scene(scene)


def test_the_digest_is_that_of_the_member_in_a_shard() -> None:
    sample = tiny_sample()
    member = encode_sample(sample)["scene.safetensors"]
    assert scene_digest(sample.scene) == sha256_hex(member)
    moved = tiny_scene(fov_deg=np.array([45, 41], np.float32))
    assert scene_digest(moved) != scene_digest(tiny_scene())
    assert scene_digest(tiny_scene(provenance={})) == scene_digest(tiny_scene())


def test_a_scene_that_breaks_a_law_is_not_written() -> None:
    with pytest.raises(TrilightError, match="fov_deg"):
        encode_scene(tiny_scene(fov_deg=np.array([45, 181], np.float32)))


@for_each(
    ("change", "message"),
    [
        (lambda arrays: {"faces": None}, "missing or not expected: 'faces'"),
        (lambda arrays: {"extra": arrays["fov_deg"]}, "missing or not expected: 'extra'"),
        (
            lambda arrays: {"faces": arrays["faces"].astype(np.int64)},
            r"faces is \['I64', \[3, 3\]\]; expected U32",
        ),
    ],
)
def test_arrays_are_exactly_those_of_a_scene(
    change: Callable[[dict[str, Any]], dict[str, Any]], message: str
) -> None:
    arrays = {name: getattr(tiny_scene(), name) for name in ARRAY_FIELDS}
    changed = {name: each for name, each in (arrays | change(arrays)).items() if each is not None}
    data = save(changed, {KEY: json.dumps(_metadata())})
    with pytest.raises(TrilightError, match=f"^a.safetensors: .*{message}"):
        decode_scene_file(data, "a.safetensors")


def test_a_file_without_our_metadata_is_no_scene() -> None:
    arrays = {name: getattr(tiny_scene(), name) for name in ARRAY_FIELDS}
    with pytest.raises(TrilightError, match=f"metadata {KEY} are missing"):
        decode_scene_file(save(arrays), "a")
    with pytest.raises(TrilightError, match="not JSON"):
        decode_scene_file(save(arrays, {KEY: "[" * 100_000}), "a")


@for_each(
    ("change", "message"),
    [
        ({"schema_version": 99}, "schema version 99"),
        ({"schema_version": None}, "schema version None"),
        ({"objects": {}}, "objects is {}"),
        ({"objects": [1, 2]}, r"objects\[0\] is 1"),
        ({"objects": [{"name": "x", "kind": "shell"}]}, "exactly the fields attribution"),
        ({"provenance": []}, r"provenance is \[\]"),
        ({"provenance": {"template": [5]}}, r"provenance.template is \[5\]; expected text"),
        (
            {"provenance": {"excursion": {"axis": "x"}}},
            "excursion is .* expected an axis",
        ),
        ({"provenance": {"x": float("nan")}}, "NaN is no JSON number"),
    ],
)
def test_metadata_are_exactly_those_of_a_scene(change: dict[str, Any], message: str) -> None:
    with pytest.raises(TrilightError, match=message) as caught:
        decode_scene_file(_stating(_metadata() | change), "a")
    assert "\n" not in str(caught.value)


@for_each(("field", "value"), [("kind", "lamp"), ("name", 3), ("uid", ["x"])])
def test_fields_of_objects_are_checked(field: str, value: Any) -> None:
    metadata = _metadata()
    metadata["objects"][1][field] = value
    with pytest.raises(TrilightError, match=rf"objects\[1\].{field} is "):
        decode_scene_file(_stating(metadata), "a")


def test_a_shape_that_claims_too_much_is_refused_before_any_array_is_made() -> None:
    data = encode_scene(tiny_scene())
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["fov_deg"]["shape"] = [1 << 40]
    bomb = json.dumps(header).encode()
    with pytest.raises(TrilightError, match="fov_deg is"):
        decode_scene_file(len(bomb).to_bytes(8, "little") + bomb + data[8 + length :], "a")


@for_each("kept", [0, 7, 8, 100, -1])
def test_a_cut_file_is_refused(kept: int) -> None:
    with pytest.raises(TrilightError, match="^a: "):
        decode_scene_file(encode_scene(tiny_scene())[:kept], "a")


def test_every_flipped_byte_is_a_scene_or_one_clear_line() -> None:
    """No damage ends in anything but a lawful scene or a TrilightError."""
    data, rng = encode_scene(tiny_scene()), np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(data), 400):
        damaged = bytearray(data)
        damaged[at] ^= int(rng.integers(1, 256))
        try:
            decode_scene_file(bytes(damaged), "a").check()
        except TrilightError:
            refused += 1
    assert refused > 100


def test_no_file_is_written_that_would_be_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    size = len(encode_scene(tiny_scene()))
    monkeypatch.setattr("storage.records.scene_file.MAX_FILE_BYTES", size)
    assert decode_scene_file(encode_scene(tiny_scene()), "a").objects == tiny_scene().objects
    monkeypatch.setattr("storage.records.scene_file.MAX_FILE_BYTES", size - 1)
    with pytest.raises(TrilightError, match=f"takes {size} bytes"):
        encode_scene(tiny_scene())


def test_a_large_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.safetensors"
    with path.open("wb") as stream:
        stream.truncate(MAX_FILE_BYTES + 1)  # a hole: it takes no room
    with pytest.raises(TrilightError, match="large.safetensors: expected a regular file"):
        read_scene_file(path)
    with pytest.raises(TrilightError, match="cannot be read"):
        read_scene_file(tmp_path / "absent.safetensors")
    path.write_bytes(encode_scene(tiny_scene()))
    assert read_scene_file(path).objects == tiny_scene().objects


def level(budget: int, rng: np.random.Generator) -> Level:
    return Level(
        record=LevelRecord(
            budget=budget,
            method="meshoptimizer",
            quality=dataclasses.replace(QUALITY, error_p99=1 / 3, open_edges=7),
        ),
        positions=rng.random((budget, 3)).astype(np.float32),
        faces=rng.integers(0, budget, (budget, 3)).astype(np.uint32),
    )


@pytest.fixture
def asset() -> Asset:
    rng = np.random.default_rng(0)
    return Asset(
        geometry_sha256="ab",
        source_sha256="cd",
        recipe="by hand",
        source=dataclasses.replace(SOURCE, num_faces_turned=3, front_share=0.1),
        levels=(level(20, rng), level(5, rng)),
    )


def test_an_asset_survives_the_file(asset: Asset) -> None:
    again = decode_asset(encode_asset(asset))
    for field in ("geometry_sha256", "source_sha256", "recipe", "source"):
        assert getattr(again, field) == getattr(asset, field)
    for here, there in zip(asset.levels, again.levels, strict=True):
        assert there.record == here.record
        assert (there.positions.dtype, there.faces.dtype) == (np.float32, np.uint32)
        assert np.array_equal(there.positions, here.positions)
        assert np.array_equal(there.faces, here.faces)
    assert encode_asset(again) == encode_asset(asset)


@for_each(
    "metadata",
    [
        None,
        {"asset": "not JSON"},
        {"asset": "[]"},
        {"asset": '{"levels": [{}]}'},
        {"asset": '{"levels": [{"quality": {}}]}'},
        {"asset": '{"levels": [], "source": {}}'},
        {"asset": '{"levels": [], "source": 3}'},
    ],
)
def test_another_safetensors_file_is_refused_in_one_line(metadata: dict[str, str] | None) -> None:
    with pytest.raises(TrilightError, match="asset: .*weight.* does not hold one") as refused:
        decode_asset(save({"weight": np.zeros(3, np.float32)}, metadata))
    assert "\n" not in str(refused.value)


def test_what_is_no_asset_or_was_cut_off_is_refused(asset: Asset) -> None:
    data = encode_asset(asset)
    part = len(data) // 5
    for bad in (b"", b"hello", bytes(100), b"\xff" * 100, data[:part], data[: 4 * part]):
        with case(bad[:9]), pytest.raises(TrilightError):
            decode_asset(bad)


def test_judgements_follow_from_the_facts() -> None:
    assert SOURCE.watertight and not SOURCE.repaired
    assert not dataclasses.replace(SOURCE, open_edges=1).watertight
    assert not dataclasses.replace(SOURCE, nonmanifold_edges=1).watertight
    assert dataclasses.replace(SOURCE, num_faces_turned=1).repaired
    assert dataclasses.replace(SOURCE, num_faces=SOURCE.num_faces_read - 1).repaired


@for_each("num_faces", [0, 300])
def test_ply_reads_back_in_another_program(num_faces: int) -> None:
    rng = np.random.default_rng(1)
    positions = rng.random((50, 3)).astype(np.float32)
    faces = rng.integers(0, 50, (num_faces, 3)).astype(np.uint32)
    data = encode_ply(positions, faces)
    header = data[: data.index(b"end_header\n") + 11]
    assert len(data) == len(header) + 50 * 12 + num_faces * 13
    if num_faces:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False)
        assert np.array_equal(np.asarray(mesh.vertices, np.float32), positions)
        assert np.array_equal(np.asarray(mesh.faces), faces)
