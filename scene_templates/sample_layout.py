"""Draws a whole layout: the plan, then the room, the objects in it, and the lights.

`scene_templates.placement` places objects without intersections. A plan is the family of a scene
and its counts. It depends on seed and scene index alone, never on the attempt: scenes that are hard
to compose are replaced by scenes of the same kind, so that rejection does not distort their shares.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from scene_templates.families import Family
from scene_templates.layout import Layout, ObjectPlacement, ShellPart
from scene_templates.placement import PlaceableShape, place_objects
from scene_templates.rooms import PATCH_FACES, SeparateSides
from scene_templates.sample_lights import sample_lights
from scene_templates.sample_material import sample_material
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.seeds import rng_for


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """The kind of a scene."""

    family: Family
    num_objects: int
    num_lights: int
    overlaps: bool


def scene_plan(settings: SceneSettings, *, seed: int, scene_index: int) -> ScenePlan:
    """Return the plan of a scene; a pure function of its arguments."""
    rng = rng_for(seed, "scene-plan", scene_index)
    # every excursion meets every family
    round_number = scene_index // max(1, len(settings.excursions))
    settings = settings.of_scene(scene_index)
    family = _sample_family(rng, settings, round_number)
    return ScenePlan(
        family=family,
        num_objects=int(rng.integers(*family.num_objects, endpoint=True)),
        num_lights=int(rng.integers(*settings.lights.count, endpoint=True)),
        overlaps=bool(rng.random() < settings.placement.overlap_share),
    )


def _sample_family(rng: np.random.Generator, settings: SceneSettings, round_number: int) -> Family:
    if settings.families_in_turn:
        return settings.families[round_number % len(settings.families)]
    weights = np.array([family.weight for family in settings.families])
    # By hand: how numpy's choice uses its generator is not promised to stay.
    position = rng.random() * weights.sum()
    row = int(np.searchsorted(np.cumsum(weights), position, side="right"))
    return settings.families[min(row, len(weights) - 1)]


def sample_layout(
    rng: np.random.Generator,
    settings: SceneSettings,
    plan: ScenePlan,
    shapes: Sequence[PlaceableShape],
) -> Layout:
    """Draw a layout of the planned kind.

    Args:
        rng: where the numbers come from.
        settings: the ranges; its families are ignored, since the plan has one.
        plan: the family and the counts.
        shapes: what the `plan.num_objects` objects look like.

    Raises:
        Rejected: "no_room" if the objects do not fit.
    """
    family = plan.family
    template = TEMPLATES[family.template]
    room = family.shell.sample_room(rng, template.parts)
    poses = place_objects(
        rng,
        settings.placement,
        room,
        shapes,
        object_scale=family.object_scale,
        overlaps=plan.overlaps,
    )
    draw = partial(sample_material, rng, settings.materials, smooth_share=family.smooth_share)
    surfaces = tuple(draw(kind="shell") for _ in template.parts)
    objects = tuple(ObjectPlacement(pose=pose, surface=draw(kind="object")) for pose in poses)
    centres = [pose.centre for pose in poses]
    emitters = sample_lights(rng, settings.lights, template.lights, plan.num_lights, centres)
    wall2_faces_out = isinstance(family.shell, SeparateSides) and family.shell.wall2_faces_out
    shell = tuple(
        ShellPart(
            name=name,
            positions=vertices,
            faces=PATCH_FACES[:, ::-1] if name == "wall2" and wall2_faces_out else PATCH_FACES,
            surface=surface,
        )
        for name, vertices, surface in zip(template.parts, room.positions, surfaces, strict=True)
    )
    return Layout(shell=shell, objects=objects, emitters=emitters)
