"""Composes scenes: a layout, real meshes within the triangle budget, and cameras that see them.

Scene k is a pure function of (settings, pool, seed, k, attempt). Which template it uses and how
many objects it holds depend on k alone, never on the attempt: scenes that are hard to compose are
replaced by scenes of the same kind, so that rejection does not distort their shares.
"""

from collections.abc import Sequence

import numpy as np

from pipeline.scenes.budget import levels_within
from pipeline.scenes.pieces import Piece, emitter_piece, joined, object_piece, shell_piece
from pipeline.scenes.pool import PooledAsset
from pipeline.scenes.views import next_camera, with_first_cameras
from scene_templates.layout import Layout
from scene_templates.registry import TEMPLATES
from scene_templates.settings import SceneSettings
from storage.errors import Rejected, TrilightError
from storage.scene import Scene, SceneObject
from storage.seeds import rng_for

__all__ = ["compose_scene", "next_camera"]


def compose_scene(
    settings: SceneSettings,
    pool: Sequence[PooledAsset],
    *,
    seed: int,
    scene_index: int,
    attempt: int,
) -> Scene:
    """Compose one scene.

    Args:
        settings: the ranges to draw from.
        pool: the objects of the scene's split, sorted by uid.
        seed: of the dataset, from 0.
        scene_index: which scene, from 0.
        attempt: how many times this scene was rejected before.

    Returns:
        A checked scene with `settings.num_views` cameras. Its provenance holds template,
        scene_index, attempt, seed and camera_attempts (per view, the proposal that passed).

    Raises:
        Rejected: no_room, over_budget, no_faces, no_camera or law_broken; equal arguments always
            give the same answer.
        TrilightError: where the pool is empty.
    """
    if not pool:
        raise TrilightError("scenes: the pool holds 0 objects; expected at least 1: add objects.")
    name, count = _family(settings, seed, scene_index)
    rng = rng_for(seed, "scene", scene_index, attempt)
    layout = TEMPLATES[name].layout_rand(rng, settings, count)
    chosen = [pool[row] for row in rng.integers(len(pool), size=count)]
    pieces = _pieces(layout, chosen, settings, rng)
    scene = Scene(
        **joined(pieces),
        c2w=np.zeros((0, 4, 4), np.float32),
        fov_deg=np.zeros(0, np.float32),
        objects=tuple(piece.entry for piece in pieces),
        provenance={
            "template": name,
            "scene_index": scene_index,
            "attempt": attempt,
            "seed": seed,
            "camera_attempts": [],
        },
    )
    return _checked(with_first_cameras(scene, settings))


def _family(settings: SceneSettings, seed: int, scene_index: int) -> tuple[str, int]:
    """Return the template and the number of objects of a scene, whatever the attempt."""
    rng = rng_for(seed, "scene-family", scene_index)
    name = settings.templates[int(rng.integers(len(settings.templates)))]
    low, high = settings.num_objects
    return name, int(rng.integers(low, high + 1))


def _pieces(
    layout: Layout,
    chosen: Sequence[PooledAsset],
    settings: SceneSettings,
    rng: np.random.Generator,
) -> list[Piece]:
    angle_deg = settings.smooth_angle_deg
    shell = [shell_piece(part, rng, angle_deg) for part in layout.shell]
    emitters = [emitter_piece(emitter, row) for row, emitter in enumerate(layout.emitters)]
    used = sum(len(piece.mesh.faces) for piece in [*shell, *emitters])
    levels = levels_within([entry.asset for entry in chosen], settings.max_triangles - used)
    taken = [piece.entry.name for piece in [*shell, *emitters]]
    objects = []
    for pooled, level, placement in zip(chosen, levels, layout.objects, strict=True):
        entry = _entry(pooled, taken)
        taken.append(entry.name)
        objects.append(object_piece(entry, level, placement, layout.floor, rng, angle_deg))
    return [*shell, *objects, *emitters]


def _entry(pooled: PooledAsset, taken: Sequence[str]) -> SceneObject:
    """Return the row of an object, under the end of its uid or the first free variant of it."""
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


def _checked(scene: Scene) -> Scene:
    try:
        scene.check()
    except TrilightError as error:
        raise Rejected("law_broken", str(error)) from error
    return scene
