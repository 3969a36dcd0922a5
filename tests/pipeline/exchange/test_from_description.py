"""From scene files to scenes: places against a slow twin, materials, kinds, colours, refusals."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from pipeline.exchange.from_description import DescribedObject, scaled_albedo_notes
from storage.errors import TrilightError
from storage.records.material import DIFFUSE, EMISSION, ROUGHNESS, SPECULAR
from storage.records.scene import Scene
from tests.for_each import for_each
from tests.pipeline.scenes.example_scenes import (
    EXAMPLES,
    PlainObj,
    corners_of,
    example_scene,
    plain_obj,
)
from tests.pipeline.scenes.one_box import (
    CAMERA,
    MATERIAL,
    TRANSFORM,
    built,
    described,
    loaded,
)

Point = tuple[float, float, float]


@pytest.fixture(scope="module")
def examples(shared: Path) -> dict[str, Scene]:
    return {name: example_scene(shared, name) for name in EXAMPLES}


def _json(shared: Path, name: str) -> dict[str, Any]:
    text = (shared / "renderformer_scenes" / f"{name}.json").read_text()
    return dict(json.loads(text)["objects"])


def _slowly(point: Point, obj: PlainObj, transform: dict[str, Any]) -> Point:
    """Place one point with nothing but sums, sines and cosines."""
    x, y, z = point
    if transform["normalize"]:
        count = len(obj.points)
        mx, my, mz = (sum(p[axis] for p in obj.points) / count for axis in range(3))
        reach = max(math.dist(p, (mx, my, mz)) for p in obj.points)
        x, y, z = (x - mx) / reach / 2, (y - my) / reach / 2, (z - mz) / reach / 2
    a, b, c = (math.radians(angle) for angle in transform["rotation"])
    y, z = y * math.cos(a) - z * math.sin(a), y * math.sin(a) + z * math.cos(a)
    z, x = z * math.cos(b) - x * math.sin(b), z * math.sin(b) + x * math.cos(b)
    x, y = x * math.cos(c) - y * math.sin(c), x * math.sin(c) + y * math.cos(c)
    (sx, sy, sz), (tx, ty, tz) = transform["scale"], transform["translation"]
    return x * sx + tx, y * sy + ty, z * sz + tz


@for_each("name", EXAMPLES)
def test_every_corner_of_the_examples_is_where_a_slow_twin_puts_it(
    examples: dict[str, Scene], shared: Path, name: str
) -> None:
    assert examples[name].num_triangles == EXAMPLES[name]
    for row, stated in enumerate(_json(shared, name).values()):
        obj = plain_obj(shared / "renderformer_scenes" / stated["mesh_path"])
        assert (examples[name].object_index == row).sum() == len(obj.triangles)
        step = max(1, len(obj.triangles) // 100)  # the twin needs all vertices for each point
        expected = [
            [_slowly(point, obj, stated["transform"]) for point in triangle]
            for triangle in obj.triangles[::step]
        ]
        found = corners_of(examples[name], row)[::step]
        if "compose/obj0" in stated["mesh_path"] or "compose/obj1" in stated["mesh_path"]:
            # quads: the loader puts their halves elsewhere, so that only the points are compared
            everything = corners_of(examples[name], row).reshape(-1, 1, 3)
            wanted = np.array(expected).reshape(1, -1, 3)
            assert np.linalg.norm(everything - wanted, axis=2).min(axis=0).max() < 1e-6
        else:
            # float32 rounds coordinates of up to 2.2 by up to 1.2e-7; the sums of the vertex mean,
            # in another order, by less
            np.testing.assert_allclose(found, expected, atol=3e-7)


@for_each("name", EXAMPLES)
def test_examples_have_the_materials_and_kinds_of_their_files(
    examples: dict[str, Scene], shared: Path, name: str
) -> None:
    scene = examples[name]
    for row, (key, stated) in enumerate(_json(shared, name).items()):
        rows = np.unique(scene.material_index[scene.object_index == row])
        material, entry = stated["material"], scene.objects[row]
        assert entry.name == key
        assert entry.licence == "LicenseRef-user-provided"
        emits = max(material["emissive"]) > 0
        kind = "shell" if "backgrounds" in stated["mesh_path"] else "object"
        assert entry.kind == ("emitter" if emits else kind)
        same = [(SPECULAR, "specular"), (ROUGHNESS, "roughness"), (EMISSION, "emissive")]
        if emits or material.get("rand_tri_diffuse_seed") is None:
            assert len(rows) == 1
            same.append((DIFFUSE, "diffuse"))
        for part, name in same:
            found = scene.materials[rows][:, part]
            np.testing.assert_allclose(found, np.zeros_like(found) + material[name], rtol=1e-6)


def test_a_mirroring_scale_keeps_the_outside_outside() -> None:
    description = described(*TRANSFORM, scale=[-1, 1, 1], translation=[0, 0, 0])
    corners = corners_of(built(description), 0).astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(normals * corners.mean(axis=1), axis=1) > 0).all()


def test_every_triangle_of_an_emitter_is_an_emitter() -> None:
    scene = built(described(), light=loaded(trimesh.creation.box(), "light.obj"))
    emitters = [entry for entry in scene.objects if entry.kind == "emitter"]
    assert [entry.name for entry in emitters] == [f"light.{row}" for row in range(12)]
    assert scene.triangle_emits.sum() == 12
    rows = scene.materials[scene.material_index[scene.triangle_emits]]
    # It reflects what its file says, too.
    expected = [0.5, 0.4, 0.3, 0.1, 0.1, 0.1, 0.3, 10, 5, 0]
    np.testing.assert_allclose(rows, np.broadcast_to(expected, rows.shape), rtol=1e-6)
    np.testing.assert_array_equal(np.bincount(scene.object_index), [12, *[1] * 12])


def test_shells_are_told_by_their_folder() -> None:
    box = trimesh.creation.box()
    inside = built(described(), loaded(box, "templates/backgrounds/plane.obj"))
    assert (inside.objects[0].kind, inside.objects[0].uid) == ("shell", "")
    beside = built(described(), loaded(box, "templates/backgrounds.obj"))
    assert (beside.objects[0].kind, beside.objects[0].uid) == (
        "object",
        "templates/backgrounds.obj",
    )


def test_smooth_shading_stops_where_the_file_splits_its_vertices() -> None:
    ball = trimesh.creation.icosphere(2)
    split = trimesh.Trimesh(
        ball.triangles.reshape(-1, 3), np.arange(960).reshape(-1, 3), process=False
    )
    description = described(*TRANSFORM, scale=[1, 1, 1])
    for mesh, is_smooth in ((ball, True), (split, False)):
        scene = built(description, loaded(mesh))
        corner_normals = scene.vertex_normals[scene.faces[scene.object_index == 0]]
        assert bool((corner_normals.std(axis=1).max(axis=1) > 0.01).all()) is is_smooth


REFUSED: list[tuple[tuple[str | int, ...], dict[str, Any], str]] = [
    (MATERIAL, {"specular": [0, 0, 0.8]}, "objects.box: diffuse + specular is 1.1000; expected at"),
    (
        MATERIAL,
        {"rand_tri_diffuse_seed": 1, "random_diffuse_max": 1.0, "specular": [0.5] * 3},
        "objects.box: diffuse + specular is 1.5",
    ),
    (
        MATERIAL,
        {"specular": [0.8] * 3, "emissive": [1.0] * 3},
        "objects.box: diffuse + specular is 1.3",
    ),
    (TRANSFORM, {"scale": [0, 1, 0]}, "objects.box: no triangle of box.obj has an area"),
    (CAMERA, {"look_at": [0, -2, 0]}, "cameras[0] looks from (0.0, -2.0, 0.0) at"),
    (CAMERA, {"up": [0, 3, 0]}, "and an up that is not along the view"),
    # along the view but for 1e-16, of which a camera with an arbitrary roll was made
    (CAMERA, {"up": [0.3, 0.6, 0.9], "position": [0.1, 0.2, 0.3], "look_at": [0, 0, 0]}, "along"),
    (CAMERA, {"up": [0, 0, 0]}, "cameras[0] looks from"),
]


@for_each("path, change, message", REFUSED)
def test_what_means_nothing_is_refused_by_name(
    path: tuple[str | int, ...], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(TrilightError) as caught:
        built(described(*path, **change), albedo_over_one="refuse")
    assert str(caught.value).startswith("a.json: ")
    assert message in str(caught.value)


@pytest.mark.parametrize("emissive", [[0.0] * 3, [1.0] * 3])
def test_of_random_colours_only_those_beyond_one_are_scaled(emissive: list[float]) -> None:
    """Each by its own factor, so that hue and gloss beside colour stay; the others are untouched.

    An emitter has one colour, that of its file."""
    lit = any(emissive)
    colours = {"diffuse": [0.9, 0.6, 0.3]} if lit else {"rand_tri_diffuse_seed": 1}
    change = {"specular": [0.25, 0.2, 0.15], "random_diffuse_max": 1.0, "emissive": emissive}
    lawful = built(described(*MATERIAL, **{**change, **colours}))
    plain = built(described(*MATERIAL, **{**change, **colours, "specular": [0.0] * 3}))
    specular = np.array([0.25, 0.2, 0.15])
    box = lawful.material_index[:12]
    factors = set()
    for row, before in zip(lawful.materials[box], plain.materials[box], strict=True):
        diffuse = before[:3].astype(np.float64)
        factor = min(1.0, 1 / float((diffuse + specular).max()))
        expected = np.concatenate([factor * diffuse, factor * specular])
        assert row[:6] == pytest.approx(expected, rel=1e-6)  # the rounding of float32
        factors.add(factor)
    assert min(factors) < 1
    assert lit or max(factors) == 1
    assert lawful.provenance["albedo_scale"] == {"box": round(min(factors), 6)}
    (note,) = scaled_albedo_notes(lawful)
    assert note.startswith(f"objects.box: diffuse + specular is {1 / min(factors):.4f}, which is")


def test_names_of_emitters_may_not_meet_other_names() -> None:
    description = described()
    box, light = description.objects
    renamed: tuple[DescribedObject, ...] = (dataclasses.replace(box, name="light.0"), light)
    lit = loaded(trimesh.creation.box(), "light.obj")
    with pytest.raises(TrilightError, match="'light.0' twice"):
        built(dataclasses.replace(description, objects=renamed), light=lit)


def test_too_much_is_refused_before_indices_wrap() -> None:
    many = trimesh.creation.icosphere(6)  # 81920 triangles, more than a material index can tell
    description = described(*MATERIAL, rand_tri_diffuse_seed=1, smooth_shading=False)
    with pytest.raises(TrilightError, match="81921 materials; expected at most 65536"):
        built(description, loaded(many))
    with pytest.raises(TrilightError, match="objects.light: 81920 emitting triangles"):
        built(described(), light=loaded(many, "light.obj"))


def test_the_random_colours_of_compose_scene_are_the_published_ones(
    shared: Path,
) -> None:
    """Draw as the published converter does: a triple for each part of the split triangle soup."""
    scene = example_scene(shared, "compose-scene")
    path = shared / "renderformer_scenes/objects/compose/obj0.obj"
    mesh = trimesh.load_mesh(path, process=False)
    soup = trimesh.Trimesh(
        vertices=mesh.triangles.reshape(-1, 3),
        faces=np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        process=False,
    )
    generator = np.random.RandomState(42)
    drawn = [
        (part.triangles[0], generator.randint(0, math.ceil(256 * 0.5), (1, 3))[0] / 255)
        for part in soup.split(only_watertight=False)
    ]
    assert len(drawn) == 224
    mine = scene.object_index == 1
    found = scene.materials[scene.material_index[mine], DIFFUSE]
    for triangle, corners, colour in zip(drawn, corners_of(scene, 1), found, strict=True):
        np.testing.assert_allclose(corners, triangle[0], atol=1e-7)  # float32 of at most 0.5
        np.testing.assert_allclose(colour, triangle[1], atol=1e-7)


@pytest.mark.parametrize(("kind", "count"), [("per-triangle", 256), ("per-shading-group", 3)])
def test_random_colours_of_a_smooth_mesh(kind: str, count: int) -> None:
    rod = trimesh.creation.cylinder(0.3, 1.0, sections=64)  # two caps, and one side of 128
    change = {"rand_tri_diffuse_seed": 7, "random_diffuse_type": kind}
    scene = built(described(*MATERIAL, **change), loaded(rod))
    mine = scene.object_index == 0
    colours = scene.materials[scene.material_index[mine], DIFFUSE]
    different, rows = np.unique(colours, axis=0, return_inverse=True)
    assert len(different) == count
    assert 0 < colours.max() <= 0.5
    if count == 3:
        assert sorted(np.bincount(rows)) == [64, 64, 128]
    assert not np.array_equal(
        built(
            described(*MATERIAL, **{**change, "rand_tri_diffuse_seed": 8}), loaded(rod)
        ).materials,
        scene.materials,
    )
