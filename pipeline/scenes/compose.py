"""Composes scenes: meshes within the triangle budget, in a layout, with cameras that see them.

A scene is a pure function of (settings, pool, scene key).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.scenes.mesh_collision import MeshShape
from pipeline.scenes.pieces import (
    ScenePiece,
    Skin,
    apply_skin,
    concatenate_pieces,
    emitter_piece,
    object_piece,
    shell_piece,
    with_drawn_columns,
)
from pipeline.scenes.pool import PooledAsset, fits_of
from pipeline.scenes.posing import pose_points
from pipeline.scenes.scene_checks import require_valid
from pipeline.scenes.source_materials import source_skins, with_source_emission
from pipeline.scenes.subdivision import fill_triangles
from pipeline.scenes.textured_pieces import with_drawn_textures
from pipeline.scenes.triangle_budget import draw_rows, levels_within
from pipeline.scenes.views import with_first_cameras
from scene_templates.layout import Layout
from scene_templates.sample_layout import ScenePlan, sample_layout, scene_plan
from scene_templates.settings import SceneSettings
from scene_templates.skies.drawn_scene import scene_sky
from scene_templates.user_maps import NO_OWN_MAPS, OwnMaps
from storage.errors import TrilightError
from storage.records.material import EMISSION
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene, SceneObject
from storage.seeds import SceneKey


def compose_scene(
    settings: SceneSettings,
    pool: Sequence[PooledAsset],
    scene_key: SceneKey,
    *,
    user_maps: OwnMaps = NO_OWN_MAPS,
) -> Scene:
    """Compose one scene.

    Args:
        settings: the ranges to draw from.
        pool: the objects of the scene's split, sorted by uid.
        scene_key: seed, index and attempt of the scene.
        user_maps: the user's textures and maps of the scene's split.

    Returns:
        A checked scene with `settings.num_views` cameras. Its provenance holds template, family,
        scene_index, attempt, seed and camera_attempts (per view, the accepted proposal); for an
        excursion its axis and value; for a scene with a sky its drawn parameters; "maps" are the
        uids of the user's textures and map, if it has any.

    Raises:
        Rejected: no_room, over_budget, no_faces, no_camera, emitter_inside or law_broken; equal
            arguments always give the same result.
        TrilightError: the pool is empty.
    """
    if not pool:
        raise TrilightError("scenes: the pool holds 0 objects; expected at least 1: add objects.")
    plan = scene_plan(settings, seed=scene_key.seed, scene_index=scene_key.index)
    provenance = _provenance(settings, plan, scene_key)
    settings = settings.of_scene(scene_key.index)
    rng = scene_key.rng("scene")
    budget = settings.max_triangles - plan.family.shell_triangles - plan.num_lights
    chosen = [pool[row] for row in draw_rows(rng, fits_of(pool), plan.num_objects, budget)]
    levels = levels_within([entry.asset for entry in chosen], budget, settings.enough_error)
    shapes = [
        MeshShape(entry.locked.uid, level, settings.centring)
        for entry, level in zip(chosen, levels, strict=True)
    ]
    layout = sample_layout(rng, settings, plan, shapes)
    skins = source_skins(chosen, levels, settings.materials, scene_key)
    pieces = scene_pieces(layout, chosen, shapes, settings, rng, skins)
    pieces = with_drawn_textures(
        pieces, layout, settings.textures, scene_key, user_textures=user_maps.textures
    )
    scene = _scene_of(pieces, provenance, scene_key)
    uids = {piece.skin.uid for piece in pieces if piece.skin and piece.skin.uid}
    scene = _with_sky(scene, settings, scene_key, user_maps, uids)
    scene = with_first_cameras(without_constant_textures(scene), settings)
    require_valid(scene, settings)
    return scene


def _scene_of(
    pieces: Sequence[ScenePiece], provenance: dict[str, Any], scene_key: SceneKey
) -> Scene:
    """Return the scene of some pieces, still without cameras."""
    arrays = concatenate_pieces(pieces)
    arrays["materials"] = with_drawn_columns(arrays["materials"], scene_key)
    return Scene(
        **arrays,
        c2w=np.zeros((0, 4, 4), np.float32),
        fov_deg=np.zeros(0, np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance=provenance,
    )


def _with_sky(
    scene: Scene,
    settings: SceneSettings,
    scene_key: SceneKey,
    user_maps: OwnMaps,
    uids: set[str],
) -> Scene:
    """Return a scene with its sky, if any, and with the uids of the user's maps in it."""
    emits = scene.triangle_emits
    sky = scene_sky(
        settings.skies,
        scene.vertex_positions[scene.faces[emits]].astype(np.float64),
        scene.materials[scene.material_index[emits], EMISSION].astype(np.float64),
        scene_key,
        user_skies=user_maps.skies,
        licences=scene.licences,
    )
    provenance = dict(scene.provenance)
    if sky is not None:
        scene = dataclasses.replace(scene, environment=sky.environment)
        provenance["sky"] = sky.origin
        uids = uids | ({sky.uid} if sky.uid else set())
    if uids:
        provenance["maps"] = sorted(uids)
    return scene.with_provenance(provenance)


def _provenance(settings: SceneSettings, plan: ScenePlan, scene_key: SceneKey) -> dict[str, Any]:
    origin = {
        "template": plan.family.template,
        "family": plan.family.name,
        "scene_index": scene_key.index,
        "attempt": scene_key.attempt,
        "seed": scene_key.seed,
        "camera_attempts": [],
    }
    excursion = settings.excursion_of(scene_key.index)
    if excursion is not None:
        origin["excursion"] = {"axis": excursion.axis, "value": excursion.value}
    return origin


def scene_pieces(
    layout: Layout,
    chosen: Sequence[PooledAsset],
    shapes: Sequence[MeshShape],
    settings: SceneSettings,
    rng: np.random.Generator,
    skins: Sequence[Skin | None],
) -> list[ScenePiece]:
    """Return floor and walls, objects and emitters of a layout, the objects as `shapes`.

    An object with one of `skins` gets its textures; its emitting components become emitters at the
    end, if the settings say so.

    Raises:
        Rejected: "no_faces" if no triangle of an object has an area.
    """
    angle_deg = settings.materials.smooth_angle_deg
    shell = [shell_piece(part, rng, angle_deg) for part in layout.shell]
    emitters = [emitter_piece(emitter, row) for row, emitter in enumerate(layout.emitters)]
    taken = [piece.entry.name for piece in [*shell, *emitters]]
    objects = []
    for pooled, shape, placement, skin in zip(chosen, shapes, layout.objects, skins, strict=True):
        entry = _entry(pooled, taken)
        taken.append(entry.name)
        positions = pose_points(shape.points, placement.pose)
        surface = placement.surface
        piece = object_piece(entry, positions, shape.faces, surface, rng, angle_deg)
        objects.append(piece if skin is None else apply_skin(piece, positions, shape.faces, skin))
    objects, lights = with_source_emission(objects, emitters, settings.materials.own_emission)
    pieces = [*shell, *objects, *emitters, *lights]
    return pieces if settings.fill_to is None else fill_triangles(pieces, settings.fill_to)


def _entry(pooled: PooledAsset, taken: Sequence[str]) -> SceneObject:
    """Return the row of an object, named by the end of its uid or its first free variant."""
    locked = pooled.locked
    stem = locked.uid.rsplit("/", 1)[-1]
    variants = [stem, *(f"{stem}_{number}" for number in range(2, len(taken) + 3))]
    return SceneObject(
        name=next(name for name in variants if name not in taken),
        kind="object",
        uid=locked.uid,
        licence=locked.licence,
        attribution=locked.attribution,
        source_url=locked.source_url,
    )
