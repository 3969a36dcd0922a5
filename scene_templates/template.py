"""`Template`: a layout family as data, and the two functions that every family offers.

Following infinigen's convention, `layout(params)` builds and draws nothing, while
`layout_rand(rng, ...)` draws the parameters and builds. The families differ in the walls that they
have and the side from which they are seen and lit, and in nothing else, so that each is one value
in a file of its own.
"""

from dataclasses import dataclass

import numpy as np

from scene_templates.cameras import camera_rand
from scene_templates.layout import (
    CameraPose,
    Emitter,
    Layout,
    ObjectPlacement,
    ShellPart,
    Surface,
)
from scene_templates.lights import emitters_rand
from scene_templates.materials import surface_rand
from scene_templates.patches import PATCH_FACES, SIDES, PatchPlacement, patch
from scene_templates.placement import ObjectSpace, objects_rand
from scene_templates.rooms import floor_plane, room_rand
from scene_templates.sectors import Sector
from scene_templates.settings import SceneSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class LayoutParams:
    """All that a layout is built from; its shell parts in the order of the template."""

    patches: tuple[PatchPlacement, ...]
    """Where each shell part stands."""
    surfaces: tuple[Surface, ...]
    """What each shell part is made of."""
    objects: tuple[ObjectPlacement, ...]
    """Room for the objects."""
    emitters: tuple[Emitter, ...]
    """The lights."""


@dataclass(frozen=True, kw_only=True)
class Template:
    """A family of layouts."""

    name: str
    """As in `SceneSettings.templates`."""
    parts: tuple[str, ...]
    """Names of its shell parts (scene_templates.patches.SIDES), the floor first."""
    cameras: Sector
    """From where it is seen."""
    lights: Sector
    """From where it is lit."""

    def layout(self, params: LayoutParams) -> Layout:
        """Build a layout; a pure function of its parameters."""
        rows = zip(self.parts, params.patches, params.surfaces, strict=True)
        shell = tuple(
            ShellPart(
                name=name,
                positions=patch(SIDES[name], placement),
                faces=PATCH_FACES,
                surface=surface,
            )
            for name, placement, surface in rows
        )
        return Layout(
            shell=shell,
            floor=floor_plane(shell[0].positions),
            objects=params.objects,
            emitters=params.emitters,
        )

    def layout_rand(
        self, rng: np.random.Generator, settings: SceneSettings, num_objects: int
    ) -> Layout:
        """Draw a layout; raises Rejected("no_room") if the objects do not fit."""
        room = room_rand(rng, settings, self.parts)
        surfaces = tuple(surface_rand(rng, settings) for _ in self.parts)
        emitters = emitters_rand(rng, settings, self.lights)
        space = ObjectSpace(
            room=room,
            parts=self.parts,
            floor=floor_plane(patch(SIDES["floor"], room.patches[0])),
        )
        objects = objects_rand(rng, settings, space, num_objects)
        return self.layout(
            LayoutParams(
                patches=room.patches, surfaces=surfaces, objects=objects, emitters=emitters
            )
        )

    def camera_rand(self, rng: np.random.Generator, settings: SceneSettings) -> CameraPose:
        """Draw one camera."""
        return camera_rand(rng, settings, self.cameras)
