"""Finished scenes with new materials or lights: what changes, and what stays to the last bit."""

import dataclasses

import numpy as np
import pytest

from pipeline.builds.named import named_build
from pipeline.scenes.laws import require_laws
from pipeline.scenes.redrawn import with_new_lights, with_new_materials
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.records.material import DIFFUSE, EMISSION, SPECULAR
from storage.records.scene import Scene
from storage.records.scene_facts import lights, surfaces
from tests.pipeline.scenes.small_pool import first_scene, small_pool
from tests.scenes_by_hand import tiny_scene
from tests.textured_by_hand import sky, textured_scene

SETTINGS = named_build("smoke").scenes
SEEDED = {"seed": 7, "index": 3}


@pytest.fixture(scope="module", params=range(4))
def scene(request: pytest.FixtureRequest) -> Scene:
    """The first scene of one of the four layouts."""
    name = sorted(TEMPLATES)[request.param]
    scenes = (first_scene(SETTINGS, small_pool(), seed=0, scene_index=index) for index in range(40))
    return next(scene for scene in scenes if scene.provenance["template"] == name)


def surface_points(scene: Scene) -> list[np.ndarray]:
    """Return corners and normals of all triangles but the emitters', in their order."""
    kinds = np.array([entry.kind for entry in scene.objects])[scene.object_index]
    faces = scene.faces[kinds != "emitter"]
    return [scene.vertex_positions[faces], scene.vertex_normals[faces]]


def test_new_materials_leave_shape_light_and_the_pattern_of_colours(scene: Scene) -> None:
    new = with_new_materials(scene, SETTINGS.materials, **SEEDED, attempt=0)
    new.check()
    for name in ("vertex_positions", "vertex_normals", "faces", "object_index", "c2w"):
        assert np.array_equal(getattr(new, name), getattr(scene, name)), name
    for row in range(len(scene.objects)):
        mine = scene.object_index == row
        before = scene.materials[scene.material_index[mine]]
        after = new.materials[new.material_index[mine]]
        if scene.objects[row].kind == "emitter":
            assert np.array_equal(before, after)
            continue
        assert np.all(after[:, EMISSION] == 0)
        same = scene.material_index[mine][:, None] == scene.material_index[mine]
        assert np.array_equal(new.material_index[mine][:, None] == new.material_index[mine], same)
        assert not np.any(np.all(before[:, DIFFUSE] == after[:, DIFFUSE], axis=1))
        num_colours = len(np.unique(scene.material_index[mine]))
        assert len(np.unique(after[:, DIFFUSE], axis=0)) == num_colours
        sums = (after[:, DIFFUSE] + after[:, SPECULAR]).max(axis=1)
        assert sums.max() <= SETTINGS.materials.albedo_sum[1] + 1e-6  # rounding of float32


def test_draws_are_those_of_composition(scene: Scene) -> None:
    """The means of many draws are those of the stated ranges: albedo sums, specular shares."""
    drawn = [
        surface
        for attempt in range(40)
        for surface in surfaces(
            with_new_materials(scene, SETTINGS.materials, **SEEDED, attempt=attempt)
        )
    ]
    share = np.array([one.specular / 0.95 for one in drawn])
    # uniform in [0, 1] times a sum within 5 % of 0.95: mean 0.5, five standard errors
    assert abs(share.mean() - 0.5) < 5 * 0.29 / np.sqrt(len(drawn))
    assert len({one.roughness for one in drawn}) == len(drawn)


@pytest.mark.parametrize("count", [None, 1, 5])
def test_new_lights_leave_surfaces_and_follow_the_ranges(scene: Scene, count: int | None) -> None:
    new = with_new_lights(scene, SETTINGS.lights, count, **SEEDED, attempt=0)
    new.check()
    for before, after in zip(surface_points(scene), surface_points(new), strict=True):
        assert np.array_equal(before, after)
    old, lit = lights(scene), lights(new)
    assert len(lit) == (len(old) if count is None else count)
    assert {one.centre for one in old}.isdisjoint(one.centre for one in lit)
    low, high = SETTINGS.lights.total_emission
    total = sum(one.emission for one in lit)
    assert low * (1 - 1e-6) <= total <= high * (1 + 1e-6)  # float32
    assert [entry.kind for entry in new.objects][-len(lit) :] == ["emitter"] * len(lit)
    assert len(np.unique(new.faces)) == len(new.vertex_positions)  # no vertex is left over
    assert len(np.unique(new.material_index)) == len(new.materials)


def test_equal_arguments_give_equal_scenes_and_attempts_differ(scene: Scene) -> None:
    def redrawn(attempt: int) -> Scene:
        lit = with_new_lights(scene, SETTINGS.lights, None, **SEEDED, attempt=attempt)
        return with_new_materials(lit, SETTINGS.materials, **SEEDED, attempt=attempt)

    first, again, other = redrawn(0), redrawn(0), redrawn(1)
    assert np.array_equal(first.materials, again.materials)
    assert np.array_equal(first.vertex_positions, again.vertex_positions)
    assert not np.array_equal(first.vertex_positions, other.vertex_positions)
    assert not np.array_equal(first.materials[:, DIFFUSE], other.materials[:, DIFFUSE])


def test_a_scene_of_a_file_draws_no_lights() -> None:
    scene = tiny_scene(provenance={"template": "renderformer-json"})
    with pytest.raises(Rejected, match="no_layout: 'renderformer-json' is no layout"):
        with_new_lights(scene, SETTINGS.lights, 1, **SEEDED, attempt=0)


def test_laws_are_those_of_composition(scene: Scene) -> None:
    """A light that is drawn into an object's box is refused, as composition refuses it."""
    near = dataclasses.replace(SETTINGS.lights, distance=(0.01, 0.02), target_jitter=0.0)
    inside = with_new_lights(scene, near, 8, **SEEDED, attempt=0)
    with pytest.raises(Rejected, match="emitter_inside"):
        require_laws(inside, SETTINGS)


def test_textures_go_with_the_materials_and_stay_with_the_triangles() -> None:
    """New materials are plain; new lamps stand behind triangles that keep their coordinates."""
    scene = textured_scene(environment=sky())
    plain = with_new_materials(scene, SETTINGS.materials, **SEEDED, attempt=0)
    plain.check()
    assert not plain.textures and plain.uv is None and plain.environment is scene.environment
    lit = with_new_lights(scene, SETTINGS.lights, 3, **SEEDED, attempt=0)
    lit.check()
    assert lit.num_triangles > scene.num_triangles and lit.environment is scene.environment
    assert lit.uv is not None and scene.uv is not None and lit.material_textures is not None
    assert np.array_equal(lit.uv[:6], scene.uv[:6]) and not lit.uv[6:].any()
    assert lit.textures == scene.textures
    assert lit.material_textures.tolist() == [
        [0, -1, 1],
        *[[-1, -1, -1]] * (len(lit.materials) - 1),
    ]


def test_a_texture_of_lamps_alone_goes_with_them() -> None:
    scene = textured_scene()
    assert scene.material_textures is not None
    index = scene.material_textures[::-1].copy()
    on_the_lamp = dataclasses.replace(scene, material_textures=index)
    on_the_lamp.check()
    lit = with_new_lights(on_the_lamp, SETTINGS.lights, 1, **SEEDED, attempt=0)
    lit.check()
    assert not lit.textures and lit.uv is None and lit.material_textures is None
