"""Layouts as data: which walls they have, and from where they are seen and lit.

Following infinigen's convention, `Template.layout(params)` builds and draws nothing, while
`sample_layout(rng, ...)` in the file of that name draws the parameters and builds.
"""

from dataclasses import dataclass

import numpy as np

from scene_templates.cameras import CameraSettings, Sector, sample_camera
from scene_templates.checks import require
from scene_templates.layout import (
    CameraPose,
    Emitter,
    Layout,
    ObjectPlacement,
    ShellPart,
    SurfaceLook,
)
from scene_templates.rooms import PATCH_FACES, SIDES, PatchPlacement, patch
from storage.registry import Registry


@dataclass(frozen=True, kw_only=True, eq=False)
class LayoutParams:
    """All that a layout is built from; its shell parts in the order of the template."""

    patches: tuple[PatchPlacement, ...]
    """Where each shell part stands."""
    surfaces: tuple[SurfaceLook, ...]
    """One look for each shell part."""
    objects: tuple[ObjectPlacement, ...]
    """Where the objects are, and what they are made of."""
    emitters: tuple[Emitter, ...]
    wall2_faces_out: bool = False
    """The second wall faces outward; see SeparateSides."""


@dataclass(frozen=True, kw_only=True)
class Template:
    """A layout."""

    name: str
    """Name by which `Family.template` refers to it."""
    parts: tuple[str, ...]
    """Names of its shell parts (scene_templates.rooms.SIDES), the floor first."""
    cameras: Sector
    """Directions from which it is seen."""
    lights: Sector
    """Directions from which it is lit."""

    def __post_init__(self) -> None:
        """Raise TrilightError for parts that no room has."""
        known = set(self.parts) <= set(SIDES) and len(set(self.parts)) == len(self.parts)
        expected = f"floor first, then any of {', '.join(SIDES)}, each once"
        name = f"parts of the template {self.name}"
        require(known and tuple(self.parts[:1]) == ("floor",), name, self.parts, expected)

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

    def sample_camera(self, rng: np.random.Generator, settings: CameraSettings) -> CameraPose:
        """Draw one camera."""
        return sample_camera(rng, settings, self.cameras)


PLANE = Template(
    name="plane",
    parts=("floor",),
    cameras=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(3, 87)),
    # Below 10 degrees a light grazes the floor, and half of the emitters see it edge-on.
    lights=Sector(azimuth_deg=0, half_width_deg=180, elevation_deg=(10, 90)),
)
"""Objects over a floor, seen and lit from all around."""

WALL = Template(
    name="wall",
    parts=("floor", "wall1"),
    # Beyond 75 degrees to the side the wall is seen edge-on.
    cameras=Sector(azimuth_deg=180, half_width_deg=75, elevation_deg=(3, 87)),
    lights=Sector(azimuth_deg=180, half_width_deg=90, elevation_deg=(10, 90)),
)
"""A floor and one wall at +X, seen and lit from the -X half."""

CORNER = Template(
    name="corner",
    parts=("floor", "wall0", "wall1"),
    cameras=Sector(azimuth_deg=225, half_width_deg=45, elevation_deg=(3, 87)),
    # A half-turn, as published: the outer lights graze one wall from behind and shine over it.
    lights=Sector(azimuth_deg=225, half_width_deg=90, elevation_deg=(10, 90)),
)
"""A floor and two walls at +X and +Y, seen from the quarter opposite them."""

OPEN_BOX = Template(
    name="open_box",
    parts=("floor", "wall0", "wall1", "wall2"),
    # Farther to the side, a camera would look at the back of the nearer wall.
    cameras=Sector(azimuth_deg=270, half_width_deg=30, elevation_deg=(3, 87)),
    # Lower, the side walls would keep an outer light from the floor.
    lights=Sector(azimuth_deg=270, half_width_deg=75, elevation_deg=(15, 90)),
)
"""A floor and three walls without a ceiling, seen and lit through the open front (-Y) and top."""

TEMPLATES: Registry[Template] = Registry(
    "template",
    Template,
    {template.name: template for template in (PLANE, WALL, CORNER, OPEN_BOX)},
    decides=("data",),
)
"""Every name that `Family.template` admits."""
