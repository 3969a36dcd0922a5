"""Families: a layout, how many objects of which size it holds, and how often it is drawn.

Trilight's own draw every layout equally often, with 1, 2 or 3 objects equally often.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar

from scene_templates.checks import SIZE, Counts, Range, require
from scene_templates.rooms import SeparateSides, SharedRoom
from scene_templates.templates import TEMPLATES
from storage.registry import Registry
from storage.settings.described import checked
from storage.settings.ranges import Share, Within


@checked("scene settings")
class Family:
    """A layout, how many objects of which size it holds, and how often it is drawn."""

    PRESETS: ClassVar[Mapping[str, Callable[[], "Family"]]] = {}
    """Functions that return a family, by its name, for `storage.settings.overrides`."""
    name: str
    """Unique name, such as `corner-multi`."""
    template: str
    """Layout: the name of a template (scene_templates.templates)."""
    weight: Annotated[float, Within(1e-9, 1e9)] = 1.0
    """How often the family is drawn, relative to the others."""
    shell: SharedRoom | SeparateSides
    """How floor and walls are placed."""
    num_objects: Annotated[Counts, Within(0, 64, unit="objects")]
    """Minimum and maximum number of objects; each count is equally likely."""
    object_scale: Annotated[Range, SIZE]
    """Diameter of an object's bounding sphere, for a room of side 2. If an object finds no free
    place, the sizes of all objects are drawn again."""
    smooth_share: Share = 0.5
    """Share of objects and shell parts with interpolated normals; the others are flat shaded."""

    def __post_init__(self) -> None:
        has_room = bool(TEMPLATES.find(self.template).parts) or self.num_objects == (1, 1)
        expected = f"(1, 1) for {self.template}, which has no room to place more in"
        require(has_room, "num_objects", self.num_objects, expected)

    @property
    def shell_triangles(self) -> int:
        """Triangles of floor and walls: 128 each."""
        return TEMPLATES[self.template].shell_triangles


DEFAULT_FAMILIES = tuple(
    Family(
        name=f"{name}-{kind}",
        template=name,
        weight=weight,
        shell=SharedRoom(),
        num_objects=num_objects,
        object_scale=object_scale,
    )
    for name in ("plane", "wall", "corner", "open_box")  # a later template joins by its name here
    for kind, weight, num_objects, object_scale in (
        ("single", 1.0, (1, 1), (1.2, 2.2)),
        ("multi", 2.0, (2, 3), (0.8, 1.8)),
    )
)
"""The sizes are the published ones of most families."""


_ALONE = Family(
    name="alone",
    template="alone",
    shell=SharedRoom(),
    num_objects=(1, 1),
    object_scale=(2.0, 2.0),
)
"""One object within a sphere of radius 0.5 around the origin."""

FAMILIES: Registry[Callable[[], Family]] = Registry(
    "family",
    Callable,
    {family.name: partial(replace, family) for family in (*DEFAULT_FAMILIES, _ALONE)},
    decides=("data",),
)
"""Functions that return a family, by its name. A preset states its families in full and asks for no
list of all, so that registering one changes no preset: `--set 'scenes.families=["plane-single"]'`
and a preset's own function choose from them."""

Family.PRESETS = FAMILIES
