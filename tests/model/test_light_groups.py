"""Groups of lights: their light adds up to the scene's, lamps stay whole, few stay as they are."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from model.light_groups import LightGroup, light_groups
from storage.records.material import EMISSION
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.renders.scene_kit import Part, box, flat, join, light, material, quad

FLOOR = quad(
    [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], material(diffuse=0.5)
)
CUBE = box([0, 0, 0.2], 0.4, material(diffuse=0.3))


def lamp(centre: tuple[float, float, float], radiance: float = 300.0) -> Part:
    triangle = 0.05 * np.array([[-1.0, 1, 0], [1, -1, 0], [1, 1, 0]])
    return light(triangle + np.array(centre), radiance)


def row_of_lamps(count: int) -> list[Part]:
    return [lamp((0.2 * at, 0, 2), 100 + at) for at in range(count)]


def emission_of(scene: Scene) -> dict[bytes, NDArray[np.float32]]:
    """Return the radiance of each emitting triangle by its corners."""
    corners = scene.vertex_positions[scene.faces[scene.triangle_emits]]
    radiance = scene.materials[scene.material_index[scene.triangle_emits], EMISSION]
    return {place.tobytes(): value for place, value in zip(corners, radiance, strict=True)}


def counts(groups: list[LightGroup]) -> list[int]:
    return [int(group.scene.triangle_emits.sum()) for group in groups]


@for_each("count", [1, 8])
def test_a_scene_within_limits_is_rendered_as_it_is(count: int) -> None:
    scene = join([FLOOR, CUBE, *row_of_lamps(count)])
    (group,) = light_groups(scene, 8)
    assert group.scene is scene
    assert group.fraction == 1


@given(count=st.integers(9, 64), most=st.integers(1, 8))
def test_the_light_of_the_groups_is_that_of_the_scene(count: int, most: int) -> None:
    scene = join([FLOOR, *row_of_lamps(count)])
    groups = light_groups(scene, most)
    assert max(counts(groups)) <= most
    assert len(groups) == -(-count // most)
    found = [
        (place, group.fraction * radiance)
        for group in groups
        for place, radiance in emission_of(group.scene).items()
    ]
    whole = emission_of(scene)
    assert [place for place, _ in found] == list(whole)
    # the division by a share and the product with it round to float32 twice
    for place, radiance in found:
        np.testing.assert_allclose(radiance, whole[place], rtol=3e-7)
    assert sum(group.fraction for group in groups) == pytest.approx(1, abs=1e-12)  # float64 sums


def test_a_group_is_as_bright_as_the_scene_and_otherwise_the_same() -> None:
    scene = join([FLOOR, CUBE, *row_of_lamps(20)])
    reflects = ~scene.triangle_emits
    for group in light_groups(scene, 8):
        alone = group.scene
        alone.check()
        np.testing.assert_array_equal(alone.faces[~alone.triangle_emits], scene.faces[reflects])
        assert alone.c2w is scene.c2w
        # equal lamps: the sums of their radiance are as their light
        total = sum(float(value.sum()) for value in emission_of(alone).values())
        expected = sum(float(value.sum()) for value in emission_of(scene).values())
        assert total == pytest.approx(expected, rel=1e-5)  # of some hundred float32 numbers
    assert scene.materials[:, EMISSION].max() < 200  # the scene itself stays as it was


def test_triangles_that_touch_are_one_lamp() -> None:
    bulb = box([0, 0, 2], 0.1, material(emission=50.0), kind="emitter")
    scene = join([FLOOR, *row_of_lamps(3), bulb])
    assert counts(light_groups(scene, 8)) == [3, 12]
    apart = [flat(bulb.triangles[at : at + 1], bulb.material, "emitter") for at in range(12)]
    assert counts(light_groups(join([FLOOR, *row_of_lamps(3), *apart]), 8)) == [3, 12]


def test_lamps_within_objects_are_not_mixed_with_others() -> None:
    within = lamp((0.05, 0, 0.2))
    assert counts(light_groups(join([FLOOR, CUBE, lamp((0, 0, 2)), within]), 8)) == [1, 1]
    assert counts(light_groups(join([FLOOR, CUBE, within]), 8)) == [1]
    # a shell is around every light of a room, and says nothing
    assert counts(light_groups(join([FLOOR, lamp((0, 0, 0)), lamp((0, 0, 2))]), 8)) == [2]


def without_area(scene: Scene, *lamps: int) -> Scene:
    """Return a scene whose emitting triangles of these numbers are points."""
    positions = scene.vertex_positions.copy()
    for face in scene.faces[scene.triangle_emits][list(lamps)]:
        positions[face] = positions[face[0]]
    return dataclasses.replace(scene, vertex_positions=positions)


def test_lamps_without_area_give_no_light() -> None:
    scene = join([FLOOR, *row_of_lamps(3)])
    assert counts(light_groups(without_area(scene, 1), 1)) == [1, 1]
    (group,) = light_groups(without_area(scene, 0, 1, 2), 1)
    assert group.fraction == 1
