"""What of a folder is no object of its user: outputs of ours, and copies that collections keep."""

import logging
import re
from pathlib import Path

import pytest

from pipeline.objects.file_filters import drop_duplicates, drop_outputs, drop_scenes, warn_once
from pipeline.objects.licences import DEFAULT_ALLOWED
from pipeline.objects.local.folder import list_folder
from pipeline.objects.maps.listing import find_maps
from storage.records.objects import TEXTURE
from tests.for_each import for_each
from tests.scenes_by_hand import tiny_scene
from trilight import write_scene

OUTPUTS = [
    "clean/assets.json clean/objects.jsonl clean/meshes/a-0123abcd.ply clean/quality.html",
    "clean/assets.json clean/meshes/a-0123abcd.ply",
    "in/d/manifest.json in/d/objects.lock.jsonl in/d/templates.png in/d/report/a.png",
    "d/manifest.json d/logs/asked.json d/contact_sheet.png",
    "objects/y/0_light_0_6.obj templates/backgrounds/y/4_box_4.obj",
    "run/settings.json run/metrics.jsonl run/validation_sheet.png",
    "coco/annotations/instances_test.json coco/test/000000003.0.png",
    "hf/train/metadata.jsonl hf/train/000000003.0.png hf/train/000000003.0.triangle.tiff",
]


@for_each("names", OUTPUTS)
def test_outputs_of_ours_are_left_out_with_a_note(
    names: str, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    mine = ["y.json", "chair.obj", "sub/table.ply", "sub/meshes/a.ply", "wood.png"]
    warn_once.cache_clear()
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert drop_outputs([*mine, *names.split()]) == mine
    folder = re.split("/(?:assets|manifest|settings|0_light|annotations|metadata)", names)[0]
    (said,) = caplog.messages
    assert said.startswith(f"left out as outputs of Trilight: {folder}")
    for name in (*mine, *names.split()):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    listed = list_folder(tmp_path, None)
    assert [row.uid for row in listed.records] == ["chair", "sub/meshes/a", "sub/table"]
    textures = find_maps(TEXTURE, str(tmp_path), licence=None, allowed_licences=DEFAULT_ALLOWED)
    assert [one.record.uid for one in textures.maps] == ["texture:wood"]
    assert textures.failures == ()


def test_the_named_folder_may_be_an_output_and_scenes_of_ours_are_no_objects(
    tmp_path: Path,
) -> None:
    names = [name.partition("/")[2] for name in OUTPUTS[0].split()]
    assert drop_outputs(names) == names
    (tmp_path / "ours.usda").write_bytes(b'#usda 1.0\n custom string trilight:sceneSha256 = "a"')
    (tmp_path / "ours.usdc").write_bytes(b"PXR-USDC" + bytes(1 << 15) + b"trilight:sceneSha256")
    write_scene(tiny_scene(), tmp_path / "ours.glb")
    (tmp_path / "theirs.usda").write_bytes(b"#usda 1.0\n")
    assert drop_scenes(tmp_path, sorted(p.name for p in tmp_path.iterdir())) == ["theirs.usda"]


def test_other_formats_without_a_twin_are_named_once(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    warn_once.cache_clear()
    for name in ("a.obj", "a.fbx", "b.fbx", "c.zip", "d.txt"):
        (tmp_path / name).write_bytes(b"x")
    assert [row.uid for row in list_folder(tmp_path, None).records] == ["a"]
    (said,) = caplog.messages
    assert "not read: b.fbx and 1 more" in said


@for_each(
    "names, kept",
    [
        ("m/raw_model.obj m/normalized_model.obj", "m/raw_model.obj"),  # 3D-FUTURE
        ("models/obj_01.ply models_eval/obj_01.ply", "models/obj_01.ply"),  # BOP
        ("models_eval/obj_01.ply", "models_eval/obj_01.ply"),
        ("mug/visual_geometry.obj mug/collision_geometry.obj", "mug/visual_geometry.obj"),  # GSO
        ("mug/meshes/model.obj", "mug/meshes/model.obj"),
        ("visual/a.obj collision/a.stl", "visual/a.obj"),  # robots
        ("collision/a.stl", "collision/a.stl"),
        ("c/google_16k/textured.obj c/google_16k/nontextured.ply c/poisson/textured.obj",
         "c/google_16k/textured.obj"),  # YCB
        ("rock_LOD0.obj rock_LOD1.obj rock_LOD2.obj tree_LOD3.obj", "rock_LOD0.obj tree_LOD3.obj"),
        ("a.obj a.stl UCX_a.obj a_coll_01.obj", "a.obj a.stl"),
        ("02958343/1a/models/model_normalized.obj", "02958343/1a/models/model_normalized.obj"),
    ],
)  # fmt: skip
def test_an_object_of_a_collection_is_one_object(names: str, kept: str) -> None:
    assert " ".join(drop_duplicates(names.split())) == kept
