"""What is decided about a scene before anything is tried: its family and its counts.

A plan depends on seed and scene index alone, never on the attempt: scenes that are hard to compose
are replaced by scenes of the same kind, so that rejection does not distort their shares.
"""

from dataclasses import dataclass

import numpy as np

from scene_templates.family import Family
from scene_templates.settings import SceneSettings
from storage.seeds import rng_for


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """The kind of a scene."""

    family: Family
    """The layout, and what goes into it."""
    num_objects: int
    """How many objects."""
    num_lights: int
    """How many emitters."""
    overlaps: bool
    """Whether objects may run into each other."""


def scene_plan(settings: SceneSettings, *, seed: int, scene_index: int) -> ScenePlan:
    """Return the plan of a scene; a pure function of its arguments."""
    rng = rng_for(seed, "scene-plan", scene_index)
    turn = scene_index // max(1, len(settings.excursions))  # every excursion meets every family
    settings = settings.of_scene(scene_index)
    family = _family_rand(rng, settings, turn)
    return ScenePlan(
        family=family,
        num_objects=_count_rand(rng, family.num_objects),
        num_lights=_count_rand(rng, settings.lights.count),
        overlaps=bool(rng.random() < settings.placement.overlap_share),
    )


def _family_rand(rng: np.random.Generator, settings: SceneSettings, turn: int) -> Family:
    if settings.families_in_turn:
        return settings.families[turn % len(settings.families)]
    weights = np.array([family.weight for family in settings.families])
    # By hand: how numpy's choice uses its generator is not promised to stay.
    position = rng.random() * weights.sum()
    row = int(np.searchsorted(np.cumsum(weights), position, side="right"))
    return settings.families[min(row, len(weights) - 1)]


def _count_rand(rng: np.random.Generator, bounds: tuple[int, int]) -> int:
    return int(rng.integers(bounds[0], bounds[1] + 1))
