"""`Template`: a layout as data, and the function that builds one from its parameters.

Following infinigen's convention, `Template.layout(params)` builds and draws nothing, while
`layout_rand(rng, ...)` in the file of that name draws the parameters and builds. The layouts differ
in the walls that they have and the side from which they are seen and lit, and in nothing else:
each is one value in scene_templates/templates.py.
"""

from dataclasses import dataclass

import numpy as np

from scene_templates.cameras import CameraSettings, camera_rand
from scene_templates.layout import (
    CameraPose,
    Emitter,
    Layout,
    ObjectPlacement,
    ShellPart,
    SurfaceLook,
)
from scene_templates.patches import PATCH_FACES, SIDES, PatchPlacement, patch
from scene_templates.sectors import Sector


@dataclass(frozen=True, kw_only=True, eq=False)
class LayoutParams:
    """All that a layout is built from; its shell parts in the order of the template."""

    patches: tuple[PatchPlacement, ...]
    """Where each shell part stands."""
    surfaces: tuple[SurfaceLook, ...]
    """What each shell part is made of."""
    objects: tuple[ObjectPlacement, ...]
    """Where the objects are, and what they are made of."""
    emitters: tuple[Emitter, ...]
    """The lights."""
    wall2_faces_out: bool = False
    """See SeparateSides."""


@dataclass(frozen=True, kw_only=True)
class Template:
    """A layout."""

    name: str
    """As in `Family.template`."""
    parts: tuple[str, ...]
    """Names of its shell parts (scene_templates.patches.SIDES), the floor first."""
    cameras: Sector
    """From where it is seen."""
    lights: Sector
    """From where it is lit."""

    @property
    def shell_triangles(self) -> int:
        """Triangles of floor and walls: 128 each."""
        return len(PATCH_FACES) * len(self.parts)

    def layout(self, params: LayoutParams) -> Layout:
        """Build a layout; a pure function of its parameters."""
        rows = zip(self.parts, params.patches, params.surfaces, strict=True)
        shell = tuple(
            ShellPart(
                name=name,
                positions=patch(SIDES[name], placement),
                faces=PATCH_FACES[:, ::-1]
                if name == "wall2" and params.wall2_faces_out
                else PATCH_FACES,
                surface=surface,
            )
            for name, placement, surface in rows
        )
        return Layout(shell=shell, objects=params.objects, emitters=params.emitters)

    def camera_rand(self, rng: np.random.Generator, settings: CameraSettings) -> CameraPose:
        """Draw one camera."""
        return camera_rand(rng, settings, self.cameras)
