"""A quad from a file with a picture to a traced picture: its colours are in their corners."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.renders.load_tracer import load_tracer
from pipeline.scenes.own_materials import own_skins
from pipeline.scenes.pieces import dressed, emitter_piece, joined, object_piece
from pipeline.scenes.pool import PooledAsset
from scene_templates.layout import Emitter, SurfaceLook
from scene_templates.materials import MaterialSettings
from storage.conventions import look_at_c2w
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene, SceneObject
from tests.pipeline.assets.meshes_by_hand import prepare
from tests.pipeline.assets.own.textured_kit import (
    CORNERS,
    KEEP,
    QUARTERS,
    picture_bytes,
    textured_glb,
    textured_obj,
)
from tests.pipeline.renders.sampling import camera_of
from tests.pipeline.scenes.small_pool import small_pool

pytestmark = pytest.mark.usefixtures("llvm")

LOOK = SurfaceLook(
    diffuse_scale=1.0,
    diffuse_rgb=(0.1, 0.2, 0.3),
    specular_rgb=(0, 0, 0),
    roughness=0.5,
    smooth=False,
    colours="one",
)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_traced_picture_has_the_colours_in_their_corners(tmp_path: Path, kind: str) -> None:
    """From a file to a picture: red at the lower left, as its picture has it."""
    data = picture_bytes(CORNERS)
    path = (
        textured_glb(tmp_path / "a.glb", data)
        if kind == "glb"
        else textured_obj(tmp_path / "o" / "a.obj", data)
    )
    entry = PooledAsset(locked=small_pool()[0].locked, asset=prepare(path, KEEP))
    level = entry.asset.levels[0]
    (skin,) = own_skins(
        [entry], [level], MaterialSettings(source="object"), seed=0, scene_index=0, attempt=0
    )
    assert skin is not None
    positions = level.positions
    square = object_piece(
        SceneObject(name="square", kind="object"),
        positions,
        level.faces,
        LOOK,
        np.random.default_rng(0),
        30.0,
    )
    square = dressed(square, positions, level.faces, skin)
    lamp = emitter_piece(
        Emitter(
            triangle=np.array([[-1, -3, 2], [1, -3, 2], [0, -3, 3.0]]),
            radiance_rgb=(9.0, 9.0, 9.0),
            reflectance=0.0,
        ),
        0,
    )
    scene = without_constant_textures(
        Scene(
            **joined([square, lamp]),
            c2w=look_at_c2w(eye=[0, -2, 0], target=[0, 0, 0], up=[0, 0, 1])[None].astype(
                np.float32
            ),
            fov_deg=np.array([30], np.float32),
            objects=(square.entry, lamp.entry),
            provenance={"template": "none"},
        )
    )
    scene.check()
    assert len(scene.textures) == 1  # specular and roughness are constants
    picture = load_tracer(scene, max_depth=2, rr_depth=5).radiance(
        camera_of(scene, 32), spp=64, seed=0
    )
    centre, width = 16, 32 / (2 * 2 * np.tan(np.radians(15)))  # pixels for each metre
    for (right, up), colour in QUARTERS.items():
        row, column = int(centre - up * width), int(centre + right * width)
        seen = picture[row, column]
        lit = np.array(colour) > 0
        assert seen[lit].min() > 4 * seen[~lit].max(initial=0), (right, up, seen)
