"""Pictures of scenes that stand alone: straight alpha, normals and albedo, in every form."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipeline.exchange.exports.pictures import stands_alone
from storage.conventions import preview_srgb8, srgb8
from storage.dataset.dataset import open_dataset
from storage.records.material import DIFFUSE, SPECULAR
from storage.records.passes.pictures import view_passes
from storage.records.sample import Sample
from storage.records.scene import Scene
from tests.command_line import trilight
from tests.for_each import for_each
from tests.pipeline.documents.dataset_by_hand import furnished, locked, sample, write_dataset
from tests.sky_maps import constant


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
def dataset(tmp_path: Path) -> Path:
    shards = {"train-000000.tar": [_covered(sample(0, _alone(seen_sky=False)))]}
    write_dataset(tmp_path / "data", shards, objects=[locked("a", "CC-BY-4.0")])
    return tmp_path / "data"


def _covered(made: Sample) -> Sample:
    """Return a sample whose pictures are 0.6 times the share of each pixel that is covered."""
    pictures = [np.repeat(0.6 * _coverage(made, view)[..., None], 3, axis=-1) for view in (0, 1)]
    return dataclasses.replace(made, radiance_rgb=np.stack(pictures).astype(np.float32))


def _coverage(made: Sample, view: int) -> NDArray[np.float64]:
    found: NDArray[np.float64] = view_passes(
        made.scene, ["coverage"], view=view, resolution=16, rays_a_side=4
    )["coverage"]
    return found


def _exported(dataset: Path, form: str) -> Path:
    out = dataset.parent / form
    result = trilight(["export", str(dataset), "--form", form, "--out", str(out), "--json"])
    assert result.exit_code == 0, result.exception
    return out


@for_each(
    ("scene", "expected"),
    [
        (_alone(), True),
        (_alone(seen_sky=False), True),
        (_alone(seen_sky=True), False),
        (furnished(["a"]), False),
    ],
)
def test_a_floor_and_a_seen_sky_are_behind_objects(scene: Scene, expected: bool) -> None:
    assert stands_alone(scene) == expected


def test_nerfstudio_pictures_have_straight_alpha(dataset: Path) -> None:
    folder = _exported(dataset, "nerfstudio") / "000000000"
    (made,) = open_dataset(str(dataset)).samples("train")
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
        np.testing.assert_allclose(
            normal[seen["hit"]], seen["shading_normal"][seen["hit"]], atol=1 / 255 + 1e-6
        )
        albedo = np.asarray(Image.open(folder / frame["albedo_file_path"]))
        rows = made.scene.materials[made.scene.material_index]
        triangle = made.view_passes(["triangle"], view=view)["triangle"][seen["hit"]]
        expected = srgb8(rows[triangle][:, DIFFUSE] + rows[triangle][:, SPECULAR])
        np.testing.assert_array_equal(albedo[seen["hit"]], expected)
        assert not albedo[~seen["hit"]].any()


def test_huggingface_has_columns_of_surfaces_and_the_error_over_the_object(
    dataset: Path, tmp_path: Path
) -> None:
    from datasets import load_dataset

    out = _exported(dataset, "huggingface")
    loaded = load_dataset(str(out), cache_dir=str(tmp_path / "cache"))["train"]
    (made,) = open_dataset(str(dataset)).samples("train")
    assert len(loaded) == 2
    for row in loaded:
        assert (row["image"].mode, row["normal"].mode, row["albedo"].mode) == ("RGBA", "RGB", "RGB")
        assert row["object_noise_floor_db"] == made.views[row["view"]].object_noise_floor_db
