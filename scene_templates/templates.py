"""Layout templates as data: which walls they have, and from where they are seen and lit.

`sample_layout` in the file of that name draws one.
"""

from dataclasses import dataclass
from functools import partial

from scene_templates.checks import require
from scene_templates.rooms import PATCH_FACES, SIDES
from scene_templates.sample_camera import Sector
from storage.registry import Registry


@dataclass(frozen=True, kw_only=True)
class Template:
    """A layout."""

    name: str
    """Name by which `Family.template` refers to it."""
    parts: tuple[str, ...]
    """Names of its shell parts (scene_templates.rooms.SIDES), the floor first; may be empty."""
    cameras: Sector
    """Directions from which it is seen."""
    lights: Sector
    """Directions from which it is lit."""

    def __post_init__(self) -> None:
        """Raise TrilightError for parts that no room has."""
        known = set(self.parts) <= set(SIDES) and len(set(self.parts)) == len(self.parts)
        expected = f"none, or floor first, then any of {', '.join(SIDES)}, each once"
        name = f"parts of the template {self.name}"
        require(known and tuple(self.parts[:1]) in ((), ("floor",)), name, self.parts, expected)

    @property
    def shell_triangles(self) -> int:
        """Triangles of floor and walls: 128 each."""
        return len(PATCH_FACES) * len(self.parts)


_around = partial(Sector, azimuth_deg=0, half_width_deg=180)

_OURS = (
    # Objects over a floor, seen and lit from all around.
    Template(
        name="plane",
        parts=("floor",),
        cameras=_around(elevation_deg=(3, 87)),
        # Below 10 degrees a light grazes the floor, and half of the emitters see it edge-on.
        lights=_around(elevation_deg=(10, 90)),
    ),
    # A floor and one wall at +X, seen and lit from the -X half.
    Template(
        name="wall",
        parts=("floor", "wall1"),
        # Beyond 75 degrees to the side the wall is seen edge-on.
        cameras=Sector(azimuth_deg=180, half_width_deg=75, elevation_deg=(3, 87)),
        lights=Sector(azimuth_deg=180, half_width_deg=90, elevation_deg=(10, 90)),
    ),
    # A floor and two walls at +X and +Y, seen from the quarter opposite them.
    Template(
        name="corner",
        parts=("floor", "wall0", "wall1"),
        cameras=Sector(azimuth_deg=225, half_width_deg=45, elevation_deg=(3, 87)),
        # A half-turn, as published: the outer lights graze one wall from behind and shine over it.
        lights=Sector(azimuth_deg=225, half_width_deg=90, elevation_deg=(10, 90)),
    ),
    # A floor and three walls without a ceiling, seen and lit through the open front (-Y) and top.
    Template(
        name="open_box",
        parts=("floor", "wall0", "wall1", "wall2"),
        # Farther to the side, a camera would look at the back of the nearer wall.
        cameras=Sector(azimuth_deg=270, half_width_deg=30, elevation_deg=(3, 87)),
        # Lower, the side walls would keep an outer light from the floor.
        lights=Sector(azimuth_deg=270, half_width_deg=75, elevation_deg=(15, 90)),
    ),
    # One object in the middle of nothing, seen and lit from everywhere. Nearer to a pole, +Z is no
    # direction for a picture's top.
    Template(
        name="alone",
        parts=(),
        cameras=_around(elevation_deg=(-89, 89)),
        lights=_around(elevation_deg=(-90, 90)),
    ),
)

TEMPLATES: Registry[Template] = Registry(
    "template", Template, {template.name: template for template in _OURS}, decides=("data",)
)
"""Every name that `Family.template` admits."""
