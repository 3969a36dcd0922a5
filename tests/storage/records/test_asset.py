"""Asset files and PLY files read back as they were written."""

import dataclasses
import io

import numpy as np
import pytest
import trimesh
from safetensors.numpy import save

from pipeline.objects.ply import encode_ply
from storage.errors import TrilightError
from storage.records.asset import Asset, Level, LevelRecord, decode_asset, encode_asset
from tests.for_each import for_each
from tests.pipeline.scenes.small_pool import QUALITY, SOURCE


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


def test_equal_assets_have_equal_files(asset: Asset) -> None:
    assert encode_asset(decode_asset(encode_asset(asset))) == encode_asset(asset)


@for_each("data", [b"", b"hello", bytes(100), b"\xff" * 100])
def test_what_is_no_asset_is_said_to_be_none(data: bytes) -> None:
    with pytest.raises(TrilightError):
        decode_asset(data)


@for_each(
    "metadata",
    [
        None,
        {"asset": "not JSON"},
        {"asset": "[]"},
        {"asset": "{}"},
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


@for_each("keep", [0.2, 0.9])
def test_an_asset_that_was_cut_off(asset: Asset, keep: float) -> None:
    data = encode_asset(asset)
    with pytest.raises(TrilightError):
        decode_asset(data[: int(keep * len(data))])


def test_judgements_follow_from_the_facts() -> None:
    assert SOURCE.watertight and not SOURCE.repaired
    assert not dataclasses.replace(SOURCE, open_edges=1).watertight
    assert not dataclasses.replace(SOURCE, nonmanifold_edges=1).watertight
    assert dataclasses.replace(SOURCE, num_faces_turned=1).repaired
    assert dataclasses.replace(SOURCE, num_faces=SOURCE.num_faces_read - 1).repaired


@for_each("num_faces", [0, 1, 300])
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
