"""Exports: each opens in the library that it is for; the published loader reads what ours reads."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from model.scene_tensors import scene_tensors
from pipeline.exchange.exports import export
from pipeline.exchange.exports.pictures import stands_alone
from pipeline.exchange.reader import load_source, scene_source
from storage.conventions import in_camera, preview_srgb8, srgb8
from storage.dataset.dataset import open_dataset
from storage.records.exr import decode_exr
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.passes import view_passes
from storage.records.sample import PictureErrors, Sample
from storage.records.scene import Scene
from tests.command_line import expect_json, expect_mistake
from tests.for_each import for_each
from tests.foreign_packages import nerfstudio_pictures
from tests.pipeline.documents.dataset_by_hand import (
    files_of,
    furnished,
    locked,
    sample,
    write_dataset,
)
from tests.pipeline.scenes.small_pool import ray_distances
from tests.sky_maps import constant
from tests.train.toy import VIEWS, toy_sample, write_toy_dataset

PX = 16
"""Pixels across the pictures."""
KEYS = ("000000000", "000000001")


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("set")
    write_toy_dataset(root / "toy", train=2, validation=1, per_shard=2, resolution=PX)
    words = ["--form", "benchmark", "--split", "train"]
    expect_json("export", root / "toy", *words, "--out", root / "out")
    return root / "out"


def rays_as_published(pose: NDArray, fov_deg: float, pixels: int) -> tuple[NDArray, NDArray]:
    """Eye and unit directions [R, R, 3]: the first row on top, the camera looks along -Z, +Y up."""
    centres = np.linspace(0.5, pixels - 0.5, pixels)
    x, y = np.meshgrid(centres, centres)
    focal = pixels / 2 / np.tan(0.5 * fov_deg / 180 * np.pi)
    local = np.stack([(x - pixels / 2) / focal, -(y - pixels / 2) / focal, -np.ones_like(x)], -1)
    directions = (local[..., None, :] * pose[:3, :3]).sum(-1)
    return pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


@pytest.mark.parametrize("key", KEYS)
def test_the_published_loader_reads_what_our_network_reads_and_our_pictures_show(
    benchmark: Path, key: str
) -> None:
    """The published inference loads five arrays of a file, as float32, nothing else."""
    sample = toy_sample(int(key), resolution=PX)
    scene, names = sample.scene, ("triangles", "texture", "vn", "c2w", "fov")
    with h5py.File(benchmark / f"h5/{key}.h5") as file:
        found = {name: np.array(file[name]).astype(np.float32) for name in names}
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

    # Published rays meet the triangles of our pictures.
    solid = np.where(sample.scene.triangle_emits[:, None, None], np.nan, found["triangles"])
    for view in range(VIEWS):
        pose = found["c2w"][view].astype(np.float64)
        eye, rays = rays_as_published(pose, float(found["fov"][view]), PX)
        flat = rays.reshape(-1, 3)
        depth = ray_distances(np.broadcast_to(eye, flat.shape), flat, solid.astype(np.float64))
        nearest = np.where(np.isfinite(depth).any(-1), depth.argmin(-1), -1)
        met = nearest.reshape(PX, PX)
        expected = sample.view_passes(["triangle"], view=view)["triangle"]
        assert (met == expected).mean() > 0.99, "edges aside, which two triangles share"
        assert len(np.unique(met)) > 3


def test_names_pair_and_targets_are_bit_for_bit(benchmark: Path) -> None:
    rows = list(csv.DictReader((benchmark / "views.csv").open()))
    named = [(row["scene"], row["view"]) for row in rows]
    assert named == [(key, str(view)) for key in KEYS for view in range(VIEWS)]
    for row in rows:
        sample = toy_sample(int(row["scene"]), resolution=PX)
        assert row["split"] == "train" and row["noise_floor_db"] == "100.000"
        target = benchmark / row["target"]
        assert target.name == export.picture_name(row["scene"], int(row["view"]))
        # the published inference drops the suffix of the HDF5 file and adds _view_N.exr
        assert target.name == f"{Path(row['h5']).stem}_view_{row['view']}.exr"
        half = sample.radiance_rgb[int(row["view"])].astype(np.float16)
        np.testing.assert_array_equal(decode_exr(target.read_bytes()), half)
        for form in ("h5", "json", "usd"):
            found, ours = load_source(scene_source(str(benchmark / row[form]))).scene, sample.scene
            theirs, mine = (
                np.sort(each.vertex_positions[each.faces].reshape(-1, 9), axis=0)
                for each in (found, ours)
            )
            assert np.allclose(theirs, mine, atol=1e-6), form
            assert np.allclose(found.c2w, ours.c2w, atol=1e-5), form
    with h5py.File(benchmark / rows[0]["h5"]) as file:
        picture = decode_exr((benchmark / rows[0]["target"]).read_bytes())
        np.testing.assert_array_equal(file["img"][0, ..., :3], picture)


def test_many_losses_are_counted_once_each_is_told() -> None:
    assert export._limit_notes("h5", ["a", "b"]) == ["h5 cannot hold a", "h5 cannot hold b"]
    told = export._limit_notes("json", [str(number) for number in range(export.MOST_NOTES + 3)])
    assert told[export.MOST_NOTES :] == ["json loses 3 more things of this kind"]
    assert set(export.SCENE_FORMS) == {"h5", "json", "usd", "exr"}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    scenes = {"train-000000.tar": [0, 1], "test-000001.tar": [2]}
    shards = {
        name: [_by_lobe(sample(i, furnished(["a"]))) for i in rows] for name, rows in scenes.items()
    }
    return attributed(tmp_path, shards)


def attributed(tmp_path: Path, shards: dict[str, list[Sample]]) -> Path:
    """Write a dataset of one object, with the table of whom to name."""
    write_dataset(tmp_path / "data", shards, objects=[locked("a", "CC-BY-4.0")])
    (tmp_path / "data/attribution.csv").write_text("uid\na\n")
    return tmp_path / "data"


def _by_lobe(whole: Sample) -> Sample:
    """Return a sample whose light is three quarters diffuse and a quarter specular."""
    light = (np.round(whole.radiance_rgb * 4) * 4).astype(np.float32)  # quarters are half floats
    floor = PictureErrors(
        noise_floor_db=40.0, noise_floor_linear_db=30.0, object_noise_floor_db=39.0
    )
    views = [
        dataclasses.replace(v, parts={"diffuse": floor, "specular": floor}) for v in whole.views
    ]
    parts = {"diffuse": light * np.float32(0.75), "specular": light * np.float32(0.25)}
    return dataclasses.replace(whole, radiance_rgb=light, parts_rgb=parts, views=tuple(views))


def exported(dataset: Path, form: str, *words: str) -> Path:
    out = dataset.parent / form
    expect_json("export", dataset, "--form", form, "--out", out, *words)
    assert (out / "attribution.csv").read_text() == "uid\na\n"
    return out


def test_nerfstudio(dataset: Path) -> None:
    """The form that its documentation states; the next test opens it there."""
    out = exported(dataset, "nerfstudio", "--scene", "1")
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["000000001"]
    folder = out / "000000001"
    _, made = open_dataset(str(dataset)).samples("train")
    transforms: dict[str, Any] = json.loads((folder / "transforms.json").read_text())
    assert transforms["camera_model"] == "OPENCV"
    seen = made.view_passes(["position_m", "hit"], view=1)
    frame = transforms["frames"][1]
    pose, depth = np.array(frame["transform_matrix"]), np.load(folder / frame["depth_file_path"])
    assert depth.dtype == np.float32 and (depth[~seen["hit"]] == 0).all()
    # the point of a pixel, as nerfstudio finds it: focal lengths, centre, and depth in 0.001 m
    row, column = np.indices((PX, PX)) + 0.5
    x, y = (column - frame["cx"]) / frame["fl_x"], -(row - frame["cy"]) / frame["fl_y"]
    local = np.stack([x, y, np.full((PX, PX), -1)], axis=-1)
    points = (0.001 * depth[..., None] * local) @ pose[:3, :3].T + pose[:3, 3]
    hit = seen["hit"]
    assert 0 < hit.mean() <= 1
    np.testing.assert_allclose(points[hit], seen["position_m"][hit], atol=1e-5)
    assert (in_camera(points[hit], pose)[:, 2] < 0).all()
    assert frame["w"] == frame["h"] == PX
    picture = np.asarray(Image.open(folder / frame["file_path"]))
    np.testing.assert_array_equal(picture, preview_srgb8(made.radiance_rgb[1]))


@pytest.mark.slow("references")
@pytest.mark.timeout(900)
def test_its_rays_and_our_depth_lead_to_our_points(dataset: Path, foreign: None) -> None:
    """Opened by nerfstudio itself."""
    folder = exported(dataset, "nerfstudio", "--scene", "1") / "000000001"
    _, made = open_dataset(str(dataset)).samples("train")
    assert set(nerfstudio_pictures(folder, made)) == {0, 1}


def test_coco(dataset: Path) -> None:
    from pycocotools.coco import COCO

    out = exported(dataset, "coco")
    names = sorted(path.name for path in (out / "annotations").iterdir())
    assert names == ["instances_test.json", "instances_train.json"]
    coco = COCO(str(out / "annotations/instances_train.json"))
    assert [each["name"] for each in coco.loadCats(coco.getCatIds())] == ["object", "shell"]
    assert len(coco.getImgIds()) == 4
    found = 0
    for image in coco.loadImgs(coco.getImgIds()):
        key, view, _ = image["file_name"].split(".")
        (made,) = (each for each in open_dataset(str(dataset)).samples("train") if each.key == key)
        picture = np.asarray(Image.open(out / "train" / image["file_name"]))
        np.testing.assert_array_equal(picture, preview_srgb8(made.radiance_rgb[int(view)]))
        ids = made.view_passes(["object"], view=int(view))["object"]
        annotations = coco.loadAnns(coco.getAnnIds(imgIds=image["id"]))
        rows = [entry.name for entry in made.scene.objects]
        shown = {rows.index(each["object_name"]) for each in annotations}
        assert shown == set(np.unique(ids[ids >= 0]).tolist())
        for each in annotations:
            row = rows.index(each["object_name"])
            mask = coco.annToMask(each).astype(bool)
            np.testing.assert_array_equal(mask, ids == row)
            x, y, width, height = each["bbox"]
            assert mask[y : y + height, x : x + width].sum() == each["area"] == mask.sum()
            assert mask[y].any() and mask[y + height - 1].any() and mask[:, x].any()
            assert mask[:, x + width - 1].any()
            assert coco.loadCats(each["category_id"])[0]["name"] == made.scene.objects[row].kind
            found += 1
    assert found >= 4


def test_huggingface(dataset: Path, tmp_path: Path) -> None:
    from datasets import load_dataset

    out = exported(dataset, "huggingface")
    loaded = load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    assert {split: rows.num_rows for split, rows in loaded.items()} == {"train": 4, "test": 2}
    made = {each.key: each for each in open_dataset(str(dataset)).samples("train")}
    for row in loaded["train"]:
        one, view = made[row["scene"]], row["view"]
        picture = preview_srgb8(one.radiance_rgb[view])
        np.testing.assert_array_equal(np.asarray(row["image"]), picture)
        seen = one.view_passes(["depth_axis_m", "object", "triangle"], view=view)
        for column, name in (("depth", "depth_axis_m"), ("object", "object")):
            values = np.asarray(row[column])
            assert values.dtype == seen[name].dtype
            np.testing.assert_array_equal(values, seen[name])
        np.testing.assert_array_equal(np.asarray(row["triangle"]), seen["triangle"])
        np.testing.assert_array_equal(np.array(row["c2w"], np.float32), one.scene.c2w[view])
        assert row["objects"] == [entry.name for entry in one.scene.objects]


def test_hypersim(dataset: Path) -> None:
    """As its README states it: https://github.com/apple/ml-hypersim."""
    out = exported(dataset, "hypersim", "--scene", "1") / "000000001"
    _, made = open_dataset(str(dataset)).samples("train")
    assert made.parts_rgb is not None

    def read(name: str) -> Any:
        with h5py.File(out / name) as file:
            return file["dataset"][...]

    final = {
        name: read(f"images/scene_cam_00_final_hdf5/frame.0001.{name}.hdf5")
        for name in ("color", "diffuse_illumination", "diffuse_reflectance", "residual")
    }
    np.testing.assert_array_equal(final["color"], made.radiance_rgb[1])
    product = final["diffuse_reflectance"] * final["diffuse_illumination"]
    np.testing.assert_allclose(product + final["residual"], final["color"], rtol=1e-6, atol=1e-6)
    reflects = final["diffuse_reflectance"] > 0
    assert reflects.any()
    np.testing.assert_allclose(product[reflects], made.parts_rgb["diffuse"][1][reflects], rtol=1e-6)
    geometry = "images/scene_cam_00_geometry_hdf5/frame.0001"
    position, depth = read(f"{geometry}.position.hdf5"), read(f"{geometry}.depth_meters.hdf5")
    eyes = read("_detail/cam_00/camera_keyframe_positions.hdf5")
    hit = np.isfinite(depth)
    distance = np.linalg.norm(position - eyes[1], axis=-1)
    np.testing.assert_allclose(distance[hit], depth[hit], rtol=1e-5)
    assert hit.any() and ((read(f"{geometry}.render_entity_id.hdf5") >= 0) == hit).all()
    turn = read("_detail/cam_00/camera_keyframe_orientations.hdf5")[1]
    world = read(f"{geometry}.normal_cam.hdf5") @ turn.T
    np.testing.assert_allclose(world[hit], read(f"{geometry}.normal_world.hdf5")[hit], atol=1e-6)


@for_each("form", export.FORMS)
def test_the_same_dataset_gives_the_same_bytes(dataset: Path, form: str) -> None:
    first = files_of(exported(dataset, form, "--split", "test"))
    (dataset.parent / form).rename(dataset.parent / f"first {form}")
    assert files_of(exported(dataset, form, "--split", "test")) == first
    assert not any("000000000" in str(path) for path in first)


def test_mistakes(dataset: Path, tmp_path: Path) -> None:
    full, new = tmp_path / "full", tmp_path / "new"
    full.mkdir()
    (full / "x").touch()
    said = expect_mistake("export", dataset, "--form", "coco", "--out", full)
    assert "is not empty; expected a new folder" in said
    words = ["--form", "coco", "--out", str(new)]
    said = expect_mistake("export", dataset, *words, "--split", "validation")
    assert "no scene in split validation" in said
    assert "no manifest.json" in expect_mistake("export", full, *words)
    shards = {"train-000000.tar": [sample(0, furnished(["a"]))]}
    write_dataset(tmp_path / "one", shards, objects=[locked("a", "CC-BY-4.0")])
    whole = expect_mistake("export", tmp_path / "one", "--form", "hypersim", "--out", new)
    assert "keeps all light together; expected diffuse and specular light apart" in whole
    assert "--set renders.split_lobes=true" in whole


def _alone(*, seen_sky: bool | None = None) -> Scene:
    """Return a scene of an object alone, below a sky that cameras see or not; None for no sky."""
    scene = furnished(["a"], "alone")
    objects = [
        dataclasses.replace(entry, kind="object") if entry.kind == "shell" else entry
        for entry in scene.objects
    ]
    sky = None if seen_sky is None else dataclasses.replace(constant(0.5), is_seen=seen_sky)
    return dataclasses.replace(scene, objects=tuple(objects), environment=sky)


@pytest.fixture
def lone(tmp_path: Path) -> Path:
    """A sample whose pictures are 0.6 times the share of each pixel that is covered."""
    made = sample(0, _alone(seen_sky=False))
    pictures = [np.repeat(0.6 * _coverage(made, view)[..., None], 3, axis=-1) for view in (0, 1)]
    made = dataclasses.replace(made, radiance_rgb=np.stack(pictures).astype(np.float32))
    return attributed(tmp_path, {"train-000000.tar": [made]})


def _coverage(made: Sample, view: int) -> NDArray[np.float64]:
    asked: dict[str, Any] = {"view": view, "resolution": 16, "rays_a_side": 4}
    return np.asarray(view_passes(made.scene, ["coverage"], **asked)["coverage"], np.float64)


def test_nerfstudio_pictures_have_straight_alpha(lone: Path) -> None:
    """A floor and a seen sky are behind objects."""
    assert stands_alone(_alone()) and stands_alone(_alone(seen_sky=False))
    assert not (stands_alone(_alone(seen_sky=True)) or stands_alone(furnished(["a"])))
    folder = exported(lone, "nerfstudio") / "000000000"
    (made,) = open_dataset(str(lone)).samples("train")
    for view, frame in enumerate(json.loads((folder / "transforms.json").read_text())["frames"]):
        rgba = np.asarray(Image.open(folder / frame["file_path"]))
        covered = _coverage(made, view)
        assert {0.0, 1.0} < set(np.unique(covered)), "edges are met"
        np.testing.assert_array_equal(rgba[..., 3], np.round(255 * covered))
        assert not rgba[covered == 0].any()
        # the same color up to the edge: half floats of radiance are right to 2^-11
        color = rgba[covered > 0][:, :3].astype(int)
        assert np.abs(color - preview_srgb8(np.full(3, 0.6))).max() <= 1
        seen = made.view_passes(["shading_normal", "hit"], view=view)
        normal = np.asarray(Image.open(folder / frame["normal_file_path"])) / 127.5 - 1
        stated = seen["shading_normal"][seen["hit"]]
        np.testing.assert_allclose(normal[seen["hit"]], stated, atol=1 / 255 + 1e-6)
        albedo = np.asarray(Image.open(folder / frame["albedo_file_path"]))
        rows = made.scene.materials[made.scene.material_index]
        triangle = made.view_passes(["triangle"], view=view)["triangle"][seen["hit"]]
        expected = srgb8(rows[triangle][:, DIFFUSE] + rows[triangle][:, SPECULAR])
        np.testing.assert_array_equal(albedo[seen["hit"]], expected)
        assert not albedo[~seen["hit"]].any()


def test_huggingface_has_columns_of_surfaces_and_the_error_over_the_object(
    lone: Path, tmp_path: Path
) -> None:
    from datasets import load_dataset

    out = exported(lone, "huggingface")
    loaded = load_dataset(str(out), cache_dir=str(tmp_path / "cache"))["train"]
    (made,) = open_dataset(str(lone)).samples("train")
    assert len(loaded) == 2
    for row in loaded:
        assert (row["image"].mode, row["normal"].mode, row["albedo"].mode) == ("RGBA", "RGB", "RGB")
        assert row["object_noise_floor_db"] == made.views[row["view"]].object_noise_floor_db
