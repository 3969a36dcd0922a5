"""Scenes from Python: lawful, the same as from a scene file, and mistakes named."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.objects.generated import encode_ply
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from tests.for_each import for_each
from trilight import Material, SceneBuilder, TrilightError, read_scene

TETRAHEDRON = (
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
)
RED = Material(diffuse=(0.8, 0.1, 0.1), specular=(0.1, 0.1, 0.1), roughness=0.2, smooth=False)


def _lit() -> SceneBuilder:
    return SceneBuilder("test").add_lamp(at=(0, -1, 2)).add_camera(at=(0, -2, 1))


def test_a_scene_of_every_part() -> None:
    builder = _lit().add_floor().add_mesh(TETRAHEDRON, RED, name="it", at=(0, 0, 0.2), size=0.5)
    scene = builder.add_builtin("rock").add_builtin("rock", number=1).scene()
    scene.check()
    assert [entry.name for entry in scene.objects] == ["lamp", "floor", "it", "rock", "rock1"]
    assert [entry.kind for entry in scene.objects] == ["emitter", "shell", *["object"] * 3]
    row = scene.materials[scene.material_index[scene.object_index == 2][0]]
    np.testing.assert_allclose(row[DIFFUSE], RED.diffuse, rtol=1e-6)
    np.testing.assert_allclose(row[SPECULAR], RED.specular, rtol=1e-6)
    assert row[ROUGHNESS] == np.float32(0.2)
    assert (row[EMISSION] == 0).all()
    points = scene.vertex_positions[scene.faces[scene.object_index == 2].ravel()].astype(float)
    mean = np.array([0, 0, 0.2])
    # the farthest vertex lies on the sphere of that diameter, to the rounding of float32
    assert np.sqrt(((points - mean) ** 2).sum(axis=1)).max() == pytest.approx(0.25, rel=1e-6)
    floor = scene.vertex_positions[scene.faces[scene.object_index == 1].ravel()]
    assert floor[:, 2] == pytest.approx(-0.5)
    assert floor[:, :2].min() == pytest.approx(-1)


def test_a_lamp_faces_its_target_with_equal_sides() -> None:
    for at in ((0.3, -1.0, 2.0), (0.0, 0.0, 2.0)):
        lamp = SceneBuilder().add_lamp(at=at, radiance=(3, 2, 1), size=0.2)
        scene = lamp.add_floor().add_camera(at=(0, -2, 1)).scene()
        corners = scene.vertex_positions[scene.faces[scene.triangle_emits][0]].astype(float)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, 0.2, rtol=1e-5)  # float32 positions of about 2 m
        np.testing.assert_allclose(corners.mean(axis=0), at, atol=1e-6)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        cosine = normal @ -np.array(at) / np.linalg.norm(normal) / np.linalg.norm(at)
        assert cosine == pytest.approx(1, abs=1e-5)
        assert scene.materials[scene.triangle_emits.argmax(), EMISSION].tolist() == [3, 2, 1]


def test_the_builder_and_a_scene_file_agree(tmp_path: Path) -> None:
    """One meaning of size, rotation and place: that of RenderFormer's files."""
    positions, faces = (np.array(part) for part in TETRAHEDRON)
    (tmp_path / "it.ply").write_bytes(encode_ply(positions.astype(float), faces))
    place = {"at": (0.1, 0.2, 0.3), "size": 0.5, "rotation_deg": (10.0, 20.0, 30.0)}
    it = (positions, faces)
    built = _lit().add_mesh(it, RED, name="it", **place).scene()  # type: ignore[arg-type]
    lamp = built.vertex_positions[built.faces[built.triangle_emits]].reshape(-1, 3)
    (tmp_path / "lamp.ply").write_bytes(encode_ply(lamp.astype(float), np.array([[0, 1, 2]])))
    (tmp_path / "scene.json").write_text(json.dumps(_described(place)))
    read = read_scene(tmp_path / "scene.json")
    for name in ("vertex_normals", "faces", "materials", "material_index", "c2w", "fov_deg"):
        np.testing.assert_array_equal(getattr(built, name), getattr(read, name), name)
    # the file's lamp went through the float32 of a PLY
    np.testing.assert_allclose(built.vertex_positions, read.vertex_positions, atol=1e-6)


def _described(place: dict[str, object]) -> dict[str, object]:
    stays = {"translation": [0, 0, 0], "rotation": [0, 0, 0], "scale": [1, 1, 1]}
    turned = {"translation": place["at"], "rotation": place["rotation_deg"], "scale": [0.5] * 3}
    red = {"diffuse": RED.diffuse, "specular": RED.specular, "roughness": 0.2}
    black = {"diffuse": [0, 0, 0], "specular": [0, 0, 0], "roughness": 1.0}
    plain = {"smooth_shading": False, "rand_tri_diffuse_seed": None, "random_diffuse_max": 1.0}
    return {
        "scene_name": "test",
        "version": "1.0",
        "objects": {
            "lamp": {
                "mesh_path": "lamp.ply",
                "transform": {**stays, "normalize": False},
                "material": {**plain, **black, "emissive": [2000] * 3},
            },
            "it": {
                "mesh_path": "it.ply",
                "transform": {**turned, "normalize": True},
                "material": {**plain, **red, "emissive": [0, 0, 0]},
            },
        },
        "cameras": [{"position": [0, -2, 1], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 40}],
    }


@for_each(
    ("mistake", "message"),
    [
        (lambda: Material(diffuse=(0.5, 0.5)), "diffuse is .*expected three finite numbers"),
        (lambda: _lit().add_mesh("missing.glb"), "missing.glb: no such file"),
        (lambda: _lit().add_mesh(([[0, 0]], [[0, 0, 0]])), r"shape \(1, 2\); expected \[V, 3\]"),
        (lambda: _lit().add_mesh(([[0, 0, 0]], [[0, 0, 1]])), "vertices 0 to 1; expected 0 to 0"),
        (lambda: _lit().add_mesh(TETRAHEDRON, size=0), "size is 0; expected meters above 0"),
        (lambda: _lit().add_mesh(TETRAHEDRON, size=np.inf), "size is inf; expected meters above"),
        (lambda: _lit().add_mesh(TETRAHEDRON, at=(0, 0)), "at is .*three finite numbers"),  # type: ignore[arg-type]
        (lambda: _lit().add_mesh(([[1, 1, 1]] * 3, [[0, 1, 2]]), size=1), "object1: all vertices"),
        (lambda: _lit().add_builtin("rok"), "did you mean rock"),
        (lambda: _lit().add_lamp(at=(0, 0, 0)), "another point"),
        (lambda: _lit().add_floor(Material(diffuse=(0.9,) * 3, specular=(0.9,) * 3)).scene(),
         "objects.floor: .*more than 1|floor.*1.8"),
        (lambda: _lit().add_mesh(TETRAHEDRON, name="a").add_mesh(TETRAHEDRON, name="a").scene(),
         "'a' twice"),
        (lambda: SceneBuilder().add_floor().add_camera(at=(0, -2, 1)).scene(), "emission"),
        (lambda: _lit().add_floor().add_camera(at=(0, 0, 0)).scene(), r"cameras\[1\] looks"),
        (lambda: SceneBuilder("empty").scene(), "empty: holds no object"),
    ],
)  # fmt: skip
def test_mistakes_are_named(mistake: Callable[[], object], message: str) -> None:
    with pytest.raises(TrilightError, match=message):
        mistake()


def test_a_file_is_the_mesh_that_its_arrays_are(tmp_path: Path) -> None:
    positions, faces = (np.array(part) for part in TETRAHEDRON)
    (tmp_path / "it.ply").write_bytes(encode_ply(positions.astype(float), faces))
    read = _lit().add_mesh(tmp_path / "it.ply", RED, size=0.5, licence="CC-BY-4.0").scene()
    given = _lit().add_mesh((positions, faces), RED, name="it", size=0.5).scene()
    np.testing.assert_array_equal(read.vertex_positions, given.vertex_positions)
    here = given.vertex_positions[given.faces[given.object_index == 1]]
    assert here.mean(axis=(0, 1)) == pytest.approx(np.zeros(3), abs=1e-6), "at the origin"
    assert (read.objects[1].name, read.objects[1].uid) == ("it", "it.ply")
    assert read.objects[1].licence == "CC-BY-4.0"
