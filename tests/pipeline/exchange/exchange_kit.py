"""A scene through one form and back, and what has to be the same then."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Usd, UsdValidation

from pipeline.assets.settings import AssetSettings
from pipeline.exchange.renderformer_h5 import read_renderformer_h5, write_renderformer_h5
from pipeline.exchange.renderformer_json import describe_scene
from pipeline.exchange.scene_files import build_scene
from pipeline.exchange.usd.read_usd import read_usd
from pipeline.exchange.usd.write_usd import write_usd
from storage.records.lookup import textured_rows
from storage.records.material import EMISSION
from storage.records.scene import Scene
from storage.records.scene_file import encode_scene


def errors_of(stage: Any) -> list[str]:
    """Return what all of USD's validators say, but for the one thing that usd-core cannot know."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 30
    return [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in UsdValidation.ValidationContext(validators).Validate(stage)
        if not (
            error.GetName() == "MissingShaderIdInRegistry" and "shaderId 'ND_" in error.GetMessage()
        )
    ]


def build_json(folder: Path, name: str, **more: Any) -> Scene:
    """Return the scene of a RenderFormer file."""
    asked = {"licence": "CC0-1.0", "num_views": None, "scene_index": 0, "seed": 0, **more}
    return build_scene(folder.resolve(), name, AssetSettings(), **asked)[0]


def json_and_back(scene: Scene, folder: Path) -> tuple[Scene, tuple[str, ...]]:
    """Return the scene that our reader makes of its RenderFormer files, and what was lost."""
    files = describe_scene(scene, "again")
    for path, data in files.meshes.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(data)
    (folder / "again.json").write_bytes(files.json)
    return build_json(folder, "again.json"), files.lost


def h5_and_back(scene: Scene, folder: Path) -> Scene:
    write_renderformer_h5(folder / "again.h5", scene)
    return read_renderformer_h5(folder / "again.h5").scene


def assert_usd_keeps_all(scene: Scene, folder: Path, suffix: str) -> None:
    """To the last bit of everything, and USD's own judges find no fault."""
    path = folder / f"again{suffix}"
    write_usd(path, scene)
    found = read_usd(path, None, None, "")
    assert not found.notes
    assert encode_scene(found.scene) == encode_scene(scene)
    assert errors_of(Usd.Stage.Open(str(path))) == []


def assert_json_keeps_light(back: Scene, scene: Scene) -> None:
    """All triangles with their materials to the last bit, and the cameras.

    A float32 rotation is orthonormal to 1e-7; the reader makes it so to the last bit.
    """
    assert np.array_equal(_sorted_rows(back), _sorted_rows(scene))
    assert np.array_equal(back.fov_deg, scene.fov_deg)
    assert np.array_equal(back.c2w[:, :3, 3], scene.c2w[:, :3, 3])
    assert back.c2w == pytest.approx(scene.c2w, abs=4e-7)


def assert_h5_keeps_light(back: Scene, scene: Scene) -> None:
    """To the last bit, in the order of the triangles; but for what emitters reflect."""
    for one, other in ((back.vertex_positions, scene.vertex_positions),
                       (back.vertex_normals, scene.vertex_normals)):  # fmt: skip
        assert np.array_equal(one[back.faces], other[scene.faces])
    found, want = (s.materials[s.material_index] for s in (back, scene))
    emits = scene.triangle_emits
    assert np.array_equal(found[~emits], want[~emits])
    assert np.array_equal(found[:, EMISSION], want[:, EMISSION])
    assert np.array_equal(back.c2w, scene.c2w)
    assert np.array_equal(back.fov_deg, scene.fov_deg)


def row_at(scene: Scene, x: float, y: float) -> np.ndarray:
    """Return the material row at a place of a flat scene, found by its barycentric coordinates."""
    corners = scene.vertex_positions[scene.faces][:, :, :2].astype(np.float64)
    for triangle, (a, b, c) in enumerate(corners):
        one, two = np.linalg.solve(np.stack([b - a, c - a], axis=1), np.array([x, y]) - a)
        if one >= -1e-9 and two >= -1e-9 and one + two <= 1 + 1e-9:
            weights = np.array([1 - one - two, one, two])
            uv = np.zeros(2) if scene.uv is None else weights @ scene.uv.reshape(-1, 3, 2)[triangle]
            return np.asarray(
                textured_rows(scene, scene.material_index[[triangle]], uv[None].astype(np.float64))
            )[0]
    raise AssertionError((x, y))


def _sorted_rows(scene: Scene) -> NDArray[np.float32]:
    """Return positions and materials [T, 19] of all triangles, sorted, corners in their order."""
    corners = scene.vertex_positions[scene.faces].reshape(-1, 9)
    rows = np.concatenate([corners, scene.materials[scene.material_index]], axis=1)
    return rows[np.lexsort(rows.T[::-1])]
