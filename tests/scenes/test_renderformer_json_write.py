"""A scene as RenderFormer's JSON and back: the same triangles in the same light."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.assets.settings import AssetSettings
from pipeline.flows.scene_files import build_scene
from pipeline.scenes.renderformer_json_write import described_files
from storage.errors import TrilightError
from storage.scene import Scene, SceneObject
from tests.scenes.example_scenes import EXAMPLES, example_scene
from tests.scenes_by_hand import LIGHT, tiny_scene


def there_and_back(scene: Scene, folder: Path) -> tuple[Scene, tuple[str, ...]]:
    files = described_files(scene, "again")
    for path, data in files.meshes.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    (folder / "again.json").write_bytes(files.json)
    back, _ = build_scene(
        folder.resolve(),
        "again.json",
        AssetSettings(),
        licence="CC0-1.0",
        num_views=None,
        scene_index=0,
        seed=0,
    )
    return back, files.lost


def rows_of(scene: Scene) -> np.ndarray:
    """Return positions and materials [T, 19] of all triangles, sorted, corners in their order."""
    corners = scene.vertex_positions[scene.faces].reshape(-1, 9)
    rows = np.concatenate([corners, scene.materials[scene.material_index]], axis=1)
    return rows[np.lexsort(rows.T[::-1])]


def assert_same_light(back: Scene, scene: Scene) -> None:
    assert np.array_equal(rows_of(back), rows_of(scene))
    assert np.array_equal(back.fov_deg, scene.fov_deg)
    assert np.array_equal(back.c2w[:, :3, 3], scene.c2w[:, :3, 3])
    # a float32 rotation is orthonormal to 1e-7; the reader makes it so to the last bit
    assert back.c2w == pytest.approx(scene.c2w, abs=4e-7)


def test_a_scene_by_hand(tmp_path: Path) -> None:
    back, lost = there_and_back(tiny_scene(), tmp_path)
    assert_same_light(back, tiny_scene())
    assert np.array_equal(
        back.vertex_normals[back.faces], tiny_scene().vertex_normals[tiny_scene().faces]
    )
    assert [(o.name, o.kind) for o in back.objects] == [("floor", "shell"), ("light", "emitter")]
    assert lost == ("uids, licences, attributions and provenance",)
    described = json.loads((tmp_path / "again.json").read_text())
    assert described["objects"]["floor"]["mesh_path"].startswith("templates/backgrounds/")


@pytest.mark.parametrize("name", list(EXAMPLES))
def test_published_scenes(shared: Path, tmp_path: Path, name: str) -> None:
    scene = example_scene(shared, name)
    back, lost = there_and_back(scene, tmp_path)
    assert_same_light(back, scene)
    again, lost_again = there_and_back(back, tmp_path)
    assert_same_light(again, back)
    one, other = (s.vertex_normals[s.faces].astype(np.float64) for s in (scene, back))
    if len(lost) == 1:  # nothing but names and rights
        assert len(one) == len(other)
    assert len(lost_again) <= len(lost)


def test_an_object_of_many_colours_and_odd_names(tmp_path: Path) -> None:
    base = tiny_scene()
    scene = dataclasses.replace(
        base,
        materials=np.concatenate([base.materials, base.materials[:1] / 2]),
        material_index=np.array([0, 2, LIGHT], np.uint16),
        objects=(
            SceneObject(name="a/..\n\0ü", kind="object", uid="u"),
            SceneObject(name="light", kind="emitter"),
        ),
    )
    back, lost = there_and_back(scene, tmp_path)
    assert_same_light(back, scene)
    assert [entry.name for entry in back.objects] == [
        "a/..__ü.material0", "a/..__ü.material2", "light",
    ]  # fmt: skip
    assert len(lost) == 1
    written = [path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*.obj")]
    assert set(written) == {"objects"}


def test_normals_that_no_reader_makes_are_said_to_be_lost(tmp_path: Path) -> None:
    base = tiny_scene()
    normals = base.vertex_normals.copy()
    normals[0] = [0.6, 0, 0.8]
    _, lost = there_and_back(dataclasses.replace(base, vertex_normals=normals), tmp_path)
    assert "floor: shading normals; readers make their own" in lost


def test_too_many_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.scenes.renderformer_json_write.MAX_OBJECTS", 1)
    with pytest.raises(TrilightError, match="2 objects of one material; a scene file holds at"):
        described_files(tiny_scene(), "a")
