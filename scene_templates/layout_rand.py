"""Draws a whole layout: the room, then the objects in it, then what shines on them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from scene_templates.family import Family
from scene_templates.layout import Layout, ObjectPlacement, SurfaceLook
from scene_templates.lights import emitters_rand
from scene_templates.materials import surface_rand
from scene_templates.patches import SIDES, patch
from scene_templates.placement import ObjectSpace, PlaceableShape, poses_rand
from scene_templates.plans import ScenePlan
from scene_templates.rooms import plane_of
from scene_templates.separate_sides import SeparateSides
from scene_templates.settings import SceneSettings
from scene_templates.template import LayoutParams
from scene_templates.templates import TEMPLATES


def layout_rand(
    rng: np.random.Generator,
    settings: SceneSettings,
    plan: ScenePlan,
    shapes: Sequence[PlaceableShape],
) -> Layout:
    """Draw a layout of the planned kind.

    Args:
        rng: where the numbers come from.
        settings: the ranges; its families are not looked at, the plan has one.
        plan: the family and the counts.
        shapes: what the `plan.num_objects` objects look like.

    Raises:
        Rejected: "no_room" if the objects do not fit.
    """
    family = plan.family
    template = TEMPLATES[family.template]
    room = family.shell.room_rand(rng, template.parts)
    placed = zip(template.parts, room.patches, strict=True)
    space = ObjectSpace(
        room=room,
        parts=template.parts,
        planes=tuple(plane_of(patch(SIDES[name], placement)) for name, placement in placed),
    )
    poses = poses_rand(
        rng,
        settings.placement,
        space,
        shapes,
        object_scale=family.object_scale,
        overlaps=plan.overlaps,
    )
    surfaces = tuple(_surface_rand(rng, settings, family, "shell") for _ in template.parts)
    objects = tuple(
        ObjectPlacement(pose=pose, surface=_surface_rand(rng, settings, family, "object"))
        for pose in poses
    )
    centres = [pose.centre for pose in poses]
    emitters = emitters_rand(rng, settings.lights, template.lights, plan.num_lights, centres)
    shell = family.shell
    return template.layout(
        LayoutParams(
            patches=room.patches,
            surfaces=surfaces,
            objects=objects,
            emitters=emitters,
            wall2_faces_out=isinstance(shell, SeparateSides) and shell.wall2_faces_out,
        )
    )


def _surface_rand(
    rng: np.random.Generator,
    settings: SceneSettings,
    family: Family,
    kind: Literal["shell", "object"],
) -> SurfaceLook:
    return surface_rand(rng, settings.materials, smooth_share=family.smooth_share, kind=kind)
