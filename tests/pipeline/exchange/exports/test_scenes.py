"""A set for others' code: the published loader reads each HDF5 as what our own network reads."""

import csv
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from model.scene_tensors import scene_tensors
from pipeline.exchange.exports.scenes import MOST_NOTES, PARTS, _told, picture_name
from pipeline.exchange.open_scene import load_source, scene_source
from storage.records.exr import decode_exr
from storage.records.material import EMISSION
from storage.records.sample import Sample
from tests.command_line import trilight
from tests.train.toy import VIEWS, toy_sample, write_toy_dataset

PX = 16
"""Pixels across the pictures."""
KEYS = ("000000000", "000000001")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("set")
    write_toy_dataset(root / "toy", train=2, validation=1, per_shard=2, resolution=PX)
    words = ["export", str(root / "toy"), "--form", "benchmark", "--split", "train"]
    result = trilight([*words, "--out", str(root / "out"), "--json"])
    assert result.exit_code == 0, result.exception
    return root / "out"


def loaded_as_published(path: Path) -> dict[str, NDArray]:
    """What the published inference loads of a file: five arrays, as float32, nothing else."""
    with h5py.File(path) as file:
        names = ("triangles", "texture", "vn", "c2w", "fov")
        return {name: np.array(file[name]).astype(np.float32) for name in names}


def rays_as_published(pose: NDArray, fov_deg: float, pixels: int) -> tuple[NDArray, NDArray]:
    """Eye and unit directions [R, R, 3]: the first row on top, the camera looks along -Z, +Y up."""
    centres = np.linspace(0.5, pixels - 0.5, pixels)
    x, y = np.meshgrid(centres, centres)
    focal = pixels / 2 / np.tan(0.5 * fov_deg / 180 * np.pi)
    local = np.stack([(x - pixels / 2) / focal, -(y - pixels / 2) / focal, -np.ones_like(x)], -1)
    directions = (local[..., None, :] * pose[:3, :3]).sum(-1)
    return pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def first_triangle(eye: NDArray, rays: NDArray, triangles: NDArray) -> NDArray[np.intp]:
    """Row of the nearest triangle along each ray, -1 where there is none; by Moeller, Trumbore."""
    a, ab, ac = (
        triangles[:, 0],
        triangles[:, 1] - triangles[:, 0],
        triangles[:, 2] - triangles[:, 0],
    )
    across = np.cross(rays[:, :, None], ac)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (across * ab).sum(-1)
        u = scale * ((eye - a) * across).sum(-1)
        turned = np.cross(eye - a, ab)
        v = scale * (rays @ turned.T)
        depth = scale * (turned * ac).sum(-1)
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 1e-6)
    depth = np.where(met, depth, np.inf)
    return np.where(met.any(-1), depth.argmin(-1), -1)


@pytest.mark.parametrize("key", KEYS)
def test_the_published_loader_reads_what_our_network_reads(exported: Path, key: str) -> None:
    sample = toy_sample(int(key), resolution=PX)
    scene, found = sample.scene, loaded_as_published(exported / f"h5/{key}.h5")
    count = scene.num_triangles
    assert {name: array.shape for name, array in found.items()} == {
        "triangles": (count, 3, 3), "vn": (count, 3, 3), "texture": (count, 13, 32, 32),
        "c2w": (VIEWS, 4, 4), "fov": (VIEWS,),
    }  # fmt: skip
    ours = scene_tensors(scene)
    np.testing.assert_array_equal(found["triangles"], ours.triangles_T33)
    np.testing.assert_array_equal(found["vn"], ours.normals_T33)
    np.testing.assert_array_equal(found["fov"], ours.fov_deg_V)

    # its pipeline: one texel where the network takes one, emission as log10(1 + x)
    texel = found["texture"][:, :, 0, 0]
    emission = np.log10(texel[:, -3:] + 1)
    np.testing.assert_allclose(emission, ours.material_TM[:, EMISSION], rtol=1e-6)
    lit = scene.triangle_emits
    assert lit.sum() == 1 and (emission[lit] > 1).all() and not emission[~lit].any()
    np.testing.assert_array_equal(texel[~lit, :7], ours.material_TM[~lit, :7])
    np.testing.assert_array_equal(texel[lit, :7], [[1, 1, 1, 0, 0, 0, 1]])  # its emitters say so
    np.testing.assert_array_equal(texel[:, 7:10], np.tile([0.5, 0.5, 1], (count, 1)))
    filled = np.add.outer(np.arange(32), np.arange(32)) <= 32
    np.testing.assert_array_equal(found["texture"] != 0, (texel != 0)[:, :, None, None] & filled)


@pytest.mark.parametrize("key", KEYS)
def test_published_rays_meet_the_triangles_of_our_pictures(exported: Path, key: str) -> None:
    sample = toy_sample(int(key), resolution=PX)
    found = loaded_as_published(exported / f"h5/{key}.h5")
    solid = np.where(sample.scene.triangle_emits[:, None, None], np.nan, found["triangles"])
    for view in range(VIEWS):
        eye, rays = rays_as_published(
            found["c2w"][view].astype(np.float64), float(found["fov"][view]), PX
        )
        met = first_triangle(eye, rays, solid.astype(np.float64))
        expected = sample.view_passes(["triangle"], view=view)["triangle"]
        assert (met == expected).mean() > 0.99, "edges aside, which two triangles share"
        assert len(np.unique(met)) > 3


def test_names_pair_and_targets_are_bit_for_bit(exported: Path) -> None:
    rows = list(csv.DictReader((exported / "views.csv").open()))
    assert [(row["scene"], row["view"]) for row in rows] == [
        (key, str(view)) for key in KEYS for view in range(VIEWS)
    ]
    for row in rows:
        sample = toy_sample(int(row["scene"]), resolution=PX)
        assert row["split"] == "train" and row["noise_floor_db"] == "100.000"
        target = exported / row["target"]
        assert target.name == picture_name(row["scene"], int(row["view"]))
        # the published inference drops the suffix of the HDF5 file and adds _view_N.exr
        assert target.name == f"{Path(row['h5']).stem}_view_{row['view']}.exr"
        half = sample.radiance_rgb[int(row["view"])].astype(np.float16)
        np.testing.assert_array_equal(decode_exr(target.read_bytes()), half)
        for form in ("h5", "json", "usd"):
            assert _same_scene(exported / row[form], sample), form
    with h5py.File(exported / rows[0]["h5"]) as file:
        picture = decode_exr((exported / rows[0]["target"]).read_bytes())
        np.testing.assert_array_equal(file["img"][0, ..., :3], picture)


def _same_scene(path: Path, sample: Sample) -> bool:
    found = load_source(scene_source(str(path))).scene
    ours = sample.scene
    theirs, mine = (
        np.sort(each.vertex_positions[each.faces].reshape(-1, 9), axis=0) for each in (found, ours)
    )
    return np.allclose(theirs, mine, atol=1e-6) and np.allclose(found.c2w, ours.c2w, atol=1e-5)


def test_many_losses_are_counted_once_each_is_told() -> None:
    assert _told("h5", ["a", "b"]) == ["h5 cannot hold a", "h5 cannot hold b"]
    told = _told("json", [str(number) for number in range(MOST_NOTES + 3)])
    assert len(told) == MOST_NOTES + 1 and told[-1] == "json loses 3 more things of this kind"
    assert set(PARTS) == {"h5", "json", "usd", "exr"}
