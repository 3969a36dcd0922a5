"""Draws new materials or lights for finished scenes, as composition draws them.

Geometry stays: the triangles of surfaces keep their order, normals, and groups of equal color. The
lamps are all emitters that belong to no object; new ones are appended in their place.
"""

import dataclasses
from typing import Any

import numpy as np

from pipeline.scenes.pieces import concatenate_pieces, emitter_piece, with_drawn_columns
from pipeline.scenes.views import object_boxes
from scene_templates.sample_lights import LightSettings, sample_lights
from scene_templates.sample_material import MaterialSettings, sample_material
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.records.material import DIFFUSE, ROUGHNESS, SPECULAR
from storage.records.retextured import NEW, chosen_maps, without_maps
from storage.records.scene import Scene
from storage.records.scene_facts import surfaces
from storage.seeds import SceneKey


def with_new_materials(scene: Scene, settings: MaterialSettings, scene_key: SceneKey) -> Scene:
    """Return the scene with new materials for each object, floor and wall; emitters stay.

    New materials have no textures. Faces that shared a row of materials within an object still
    share one, and the number of colors stays.
    """
    scene = without_maps(scene, environment=False)
    rng = scene_key.rng("new materials")
    rows = [scene.materials[:0]]
    material_index = scene.material_index.astype(np.int64)
    facts = {surface.row: surface for surface in surfaces(scene)}
    for row in range(len(scene.objects)):
        mine = scene.object_index == row
        used, within = np.unique(scene.material_index[mine], return_inverse=True)
        start = sum(map(len, rows))
        new = scene.materials[used].copy()
        if surface := facts.get(row):
            look = sample_material(
                rng,
                settings,
                smooth_share=float(surface.smooth),
                kind="shell" if surface.kind == "shell" else "object",
            )
            many = look.diffuse_scale * rng.random((len(used), 3))
            new[:, DIFFUSE] = [look.diffuse_rgb] if len(used) == 1 else many
            new[:, SPECULAR] = look.specular_rgb
            new[:, ROUGHNESS] = look.roughness
        rows.append(new)
        material_index[mine] = start + within.ravel()
    materials = with_drawn_columns(np.concatenate(rows), scene_key)
    return dataclasses.replace(
        scene, materials=materials, material_index=material_index.astype(np.uint16)
    )


def with_new_lights(
    scene: Scene,
    settings: LightSettings,
    num_lights: int | None,
    scene_key: SceneKey,
) -> Scene:
    """Return the scene with its lamps replaced by new ones, drawn by its layout.

    Emitting components of objects keep their radiance.

    Args:
        settings: the ranges to draw from; its count is not used.
        num_lights: number of new lamps; None for as many as there are.

    Raises:
        Rejected: "no_layout" if the template of the scene is no known layout.
    """
    name = scene.provenance.get("template", "unknown")
    if name not in TEMPLATES:
        raise Rejected("no_layout", f"{name!r} is no layout that draws lights; keep its lights")
    lit = np.array([entry.is_lamp for entry in scene.objects])
    count = int(lit.sum()) if num_lights is None else num_lights
    rng = scene_key.rng("new lights")
    centres = list(object_boxes(scene).sum(axis=1).astype(np.float64) / 2)
    emitters = sample_lights(rng, settings, TEMPLATES[name].lights, count, centres)
    lamps = [emitter_piece(emitter, row) for row, emitter in enumerate(emitters)]
    stays = ~lit[scene.object_index]
    faces = scene.faces[stays]
    vertices, faces_of = np.unique(faces, return_inverse=True)
    rows, rows_of = np.unique(scene.material_index[stays], return_inverse=True)
    unlit = {
        "vertex_positions": scene.vertex_positions[vertices],
        "vertex_normals": scene.vertex_normals[vertices],
        "faces": faces_of.reshape(faces.shape).astype(np.uint32),
        "material_index": rows_of.ravel().astype(np.uint16),
        "materials": scene.materials[rows],
        "object_index": (np.cumsum(~lit) - 1)[scene.object_index[stays]].astype(np.uint16),
    }
    objects = [entry for entry in scene.objects if not entry.is_lamp]
    new = concatenate_pieces(lamps)
    new["faces"] += np.uint32(len(vertices))
    new["material_index"] += np.uint16(len(rows))
    new["object_index"] += np.uint16(len(objects))
    triangles = np.append(np.flatnonzero(stays), np.full(len(new["faces"]), NEW))
    materials = np.append(rows, np.full(len(new["materials"]), NEW))
    arrays: dict[str, Any] = {
        name: np.concatenate([array, new[name]]) for name, array in unlit.items()
    }
    return dataclasses.replace(
        scene,
        **chosen_maps(scene, triangles, materials),
        **arrays,
        objects=(*objects, *(lamp.entry for lamp in lamps)),
    )
