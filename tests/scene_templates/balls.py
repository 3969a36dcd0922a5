"""Layouts without meshes: balls stand for objects, so that thousands are drawn in seconds."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_templates.families import DEFAULT_FAMILIES
from scene_templates.frozen_v1 import ONE_FAMILY_EACH
from scene_templates.layout import Layout, Pose
from scene_templates.rooms import PatchPlacement
from scene_templates.sample_layout import ScenePlan, sample_layout, scene_plan
from scene_templates.settings import SceneSettings
from scene_templates.templates import TEMPLATES
from storage.errors import Rejected
from storage.seeds import rng_for
from storage.settings.overrides import apply_overrides

DEFAULTS = SceneSettings(families=DEFAULT_FAMILIES)
"""What the training presets draw from; their budgets mean nothing where there are no meshes."""


ROOMS = [name for name, template in TEMPLATES.items() if template.parts]
"""The layouts that have a floor."""

STILL = PatchPlacement(rotation_deg=(0, 0, 0), reach=1.0, scale=(1, 1, 1), translation=(0, 0, 0))
"""Of a floor or wall that stays as it is."""


def _even_points(count: int) -> NDArray[np.float64]:
    """Points on the unit sphere by steps of the golden angle: near even, no two opposite."""
    row = np.arange(count)
    z = 1 - (2 * row + 1) / count
    turn = row * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])


class Ball:
    """A shape that is met by its whole sphere; some points of it stand for the vertices."""

    points = _even_points(48)

    def overlaps(self, pose: Pose, other: "Ball", its_pose: Pose) -> bool:
        """Return whether the spheres share a point."""
        apart = float(np.linalg.norm(pose.centre - its_pose.centre))
        return apart <= pose.radius + its_pose.radius


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """One layout and what was planned of it."""

    plan: ScenePlan
    layout: Layout
    attempt: int
    """How many were rejected before."""

    def points(self, row: int) -> NDArray[np.float64]:
        """The points of one ball in its place."""
        pose = self.layout.objects[row].pose
        return np.asarray(pose.radius * Ball.points @ pose.rotation.T + pose.centre)


def template_settings(name: str, changes: Mapping[str, Any] | None = None) -> SceneSettings:
    """Return the default settings with one layout only, of 1 to 3 objects."""
    family = next(family for family in ONE_FAMILY_EACH if family.template == name)
    return apply_overrides(SceneSettings(families=(family,)), changes or {})


BALL = Ball()


def one_drawn(
    settings: SceneSettings, scene_index: int, seed: int = 0, shape: Ball = BALL
) -> Drawn:
    """Draw the layout of a scene; where its objects find no room, the next attempt, as a run does.

    Raises:
        Rejected: as the sixteenth attempt was.
    """
    plan = scene_plan(settings, seed=seed, scene_index=scene_index)
    after = settings.of_scene(scene_index)
    for attempt in range(16):
        rng = rng_for(seed, "scene", scene_index, attempt)
        try:
            layout = sample_layout(rng, after, plan, [shape] * plan.num_objects)
        except Rejected:
            if attempt == 15:
                raise
            continue
        return Drawn(plan=plan, layout=layout, attempt=attempt)
    raise AssertionError


def drawn(settings: SceneSettings, count: int, seed: int = 0, shape: Ball = BALL) -> list[Drawn]:
    """Draw the layouts of the first `count` scenes."""
    return [one_drawn(settings, index, seed, shape) for index in range(count)]


MANY = 2000
"""Scenes for the statistics of one setting."""
