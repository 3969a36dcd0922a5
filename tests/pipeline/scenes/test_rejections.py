"""Every reason for which a scene is rejected, provoked; nothing else ever comes out."""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.builds.named import named_build
from pipeline.scenes.compose import compose_scene
from pipeline.scenes.laws import require_laws
from pipeline.scenes.pool import PooledAsset
from scene_templates.settings import SceneSettings
from storage.errors import Rejected
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.scene_templates.balls import template_settings

BLIND = {
    "views.min_coverage": 0.0,
    "views.min_lit": 0.0,
    "views.max_shell_back": 1.0,
    "views.min_depth": 0.0,
}
"""Every view is good enough."""

CROWD = {"families.num_objects": [3, 3], "placement.overlap_share": 0.0}

PROVOKED: list[tuple[str, str, Mapping[str, Any], str]] = [
    ("no_room", "open_box", {**CROWD, "families.object_scale": [2.0, 2.0]}, "3 objects met"),
    (
        "over_budget",
        "plane",
        {**CROWD, "lights.count": [8, 8], "max_triangles": 171},  # 3 objects of 12 need 172
        "3 objects of at least 12 triangles each do not fit into the 35",
    ),
    ("no_camera", "wall", {"views.min_coverage": 1.0}, "sees too little of the objects x16"),
    ("no_camera", "open_box", {"lights.count": [1, 1], "views.min_lit": 1.0}, "too little light"),
    ("no_camera", "wall", {"views.min_depth": 5.0}, "too near x16"),
    (
        "emitter_inside",
        "plane",
        {**BLIND, **CROWD, "lights.distance": [0.1, 0.1], "lights.count": [8, 8]},
        "reaches into the box of an object",
    ),
]


@for_each(("reason", "template", "changes", "message"), PROVOKED)
def test_each_reason_is_given_where_it_holds(
    pool: list[PooledAsset], reason: str, template: str, changes: Mapping[str, Any], message: str
) -> None:
    settings = template_settings(template, changes)
    found = [_rejection(settings, pool, index=0) for _ in range(2)]
    assert found[0].reason == reason
    assert message in found[0].message
    assert (found[0].reason, found[0].message) == (found[1].reason, found[1].message)


def _rejection(settings: SceneSettings, pool: Sequence[PooledAsset], index: int) -> Rejected:
    with pytest.raises(Rejected) as caught:
        compose_scene(settings, pool, seed=0, scene_index=index, attempt=0)
    return caught.value


def _with_positions(
    entry: PooledAsset, change: Callable[[NDArray[np.float32]], object]
) -> PooledAsset:
    """The same object with the positions of every level changed in place."""
    levels = []
    for level in entry.asset.levels:
        positions = level.positions.copy()
        change(positions)
        levels.append(dataclasses.replace(level, positions=positions))
    return PooledAsset(
        locked=entry.locked, asset=dataclasses.replace(entry.asset, levels=tuple(levels))
    )


def _one_nan(positions: NDArray[np.float32]) -> None:
    positions[0] = np.nan


def _one_infinite(positions: NDArray[np.float32]) -> None:
    positions[0, 1] = np.inf


def _one_point(positions: NDArray[np.float32]) -> None:
    positions[:] = 0


def _one_line(positions: NDArray[np.float32]) -> None:
    positions[:, 1:] = 0


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("build", ["smoke", "renderformer-v1-256"])
def test_a_mesh_without_usable_triangles_is_rejected(pool: list[PooledAsset], build: str) -> None:
    """The asset stage keeps such levels out; one that came through all the same costs one scene.

    An overlapping scene never asks for collisions, and one that does not would hand FCL a mesh of
    nothing: both must end alike.
    """
    settings = named_build(build, changes={"scenes.num_views": 1}).scenes
    overlapping = dataclasses.replace(
        settings, placement=dataclasses.replace(settings.placement, overlap_share=1.0)
    )
    damages = (_one_nan, _one_infinite, _one_point, _one_line)
    for damage, each, index in itertools.product(damages, (settings, overlapping), range(4)):
        damaged = [_with_positions(pool[1], damage)]
        try:
            scene = compose_scene(each, damaged, seed=0, scene_index=index, attempt=0)
        except Rejected as rejection:
            assert rejection.reason == "no_faces", (damage, rejection)
            assert "made/box" in rejection.message
            continue
        assert not any(entry.kind == "object" for entry in scene.objects), damage


def test_what_a_scene_must_be_is_looked_at_last(scenes: list[Scene]) -> None:
    """Of a scene that is fine, each law by itself."""
    settings = named_build("smoke").scenes
    scene = next(scene for scene in scenes if scene.num_triangles > 1000)
    require_laws(scene, settings)
    require_laws(scene, dataclasses.replace(settings, max_triangles=scene.num_triangles))
    tight = dataclasses.replace(settings, max_triangles=scene.num_triangles - 1)
    with pytest.raises(Rejected) as caught:
        require_laws(scene, tight)
    assert caught.value.reason == "over_budget"
    normals = scene.vertex_normals.copy()
    normals[0] = 0
    with pytest.raises(Rejected) as caught:
        require_laws(dataclasses.replace(scene, vertex_normals=normals), settings)
    assert caught.value.reason == "law_broken"
    assert "vertex_normals" in caught.value.message


def test_an_emitter_in_the_box_of_an_object_is_found_and_one_beside_it_is_not(
    scenes: list[Scene],
) -> None:
    settings = named_build("smoke").scenes
    scene = scenes[0]
    kinds = [entry.kind for entry in scene.objects]
    emitter, body = len(kinds) - 1, kinds.index("object")
    vertices = scene.faces[scene.object_index == emitter].ravel()
    target = scene.vertex_positions[scene.faces[scene.object_index == body].ravel()]
    middle, top = (target.min(axis=0) + target.max(axis=0)) / 2, target[:, 2].max()
    for height, inside in ((middle[2], True), (top - 1e-3, True), (top + 1e-3, False)):
        # Its lowest corner over the middle of the object, below the top of its box or above.
        moved = scene.vertex_positions.copy()
        corners = moved[vertices]
        moved[vertices] += np.array([*middle[:2], height], np.float32) - np.array(
            [*corners[:, :2].mean(axis=0), corners[:, 2].min()], np.float32
        )
        lit = dataclasses.replace(scene, vertex_positions=moved)
        if inside:
            with pytest.raises(Rejected) as caught:
                require_laws(lit, settings)
            assert caught.value.reason == "emitter_inside"
        else:
            require_laws(lit, settings)
