"""`SceneSettings`: everything from which a scene is drawn, in the groups of this folder.

Numbers follow the RenderFormer V1 recipes where they are known and sound; each deviation says why.
World units throughout: the nominal shell is the cube [-0.5, 0.5]^3, so sizes that the recipes
state for a cube of side 2 are halved on use (fields that hold such numbers say "before halving").

An excursion takes a scene beyond the usual range along one axis, while all else stays.
"""

import dataclasses
from dataclasses import field
from typing import Annotated, Any, Literal

from scene_templates.cameras import CameraSettings
from scene_templates.checks import OFFSET, require
from scene_templates.families import Family
from scene_templates.lights import LightSettings
from scene_templates.materials import MaterialSettings
from scene_templates.placement import PlacementSettings
from storage.settings.changes import changed
from storage.settings.described import checked
from storage.settings.ranges import FLOAT32_MAX, Share, Within


@checked("excursion")
class Excursion:
    """One value beyond the usual range, and the settings that make it."""

    axis: str
    """What is varied, such as `fov_deg`; stands in the provenance of its scenes."""
    value: Annotated[int | float, Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """The value on the axis; also in the provenance."""
    changes: tuple[tuple[str, Any], ...]
    """Dotted names of scene settings with their values (storage.settings.changes)."""


MAX_TRIANGLES = 65_535
"""Materials and objects are counted in 16 bits (storage.records.scene); a triangle may be a
material."""

MIN_TRIANGLES = 129
"""A floor and one emitter."""


@checked("scene settings")
class ViewLaws:
    """What a camera must see for its view to be rendered."""

    coverage_grid: Annotated[int, Within(1, 256, unit="rays")] = 32
    """Camera rays per side with which a view is judged."""
    min_coverage: Share = 0.02
    """Least share of the camera rays that meet an object first, where the scene has objects."""
    min_lit: Share = 0.05
    """Least share of what the camera sees that some emitter shines upon, on the side seen."""
    max_shell_back: Share = 0.1
    """Greatest share of the camera rays that meet a floor or wall from behind."""
    min_depth: Annotated[float, OFFSET] = 0.01
    """Least distance from the camera to anything, and to the bounding box of any object."""


@checked("scene settings")
class SceneSettings:
    """What scenes are drawn from. Ranges are (low, high), both ends included."""

    families: tuple[Family, ...]
    """The layouts with their objects, drawn by weight."""
    families_in_turn: bool = False
    """Take the families one after the other instead, so that each has exactly its share."""
    max_triangles: Annotated[int, Within(MIN_TRIANGLES, MAX_TRIANGLES, unit="triangles")] = 1536
    """Most triangles of a whole scene, shell and emitters included."""
    enough_error: Share = 0.005
    """Distance to its source (99th percentile, share of the diagonal) from which an object gets no
    finer: half a percent is about a pixel of a picture of 256. 0 gives all that the budget has."""
    centring: Literal["vertex_mean", "box"] = "box"
    """What becomes the centre of an object: the middle of its source's bounding box, or as
    published the mean of its vertices, which moves with the tessellation."""
    fill_to: Annotated[int | None, Within(1, MAX_TRIANGLES, unit="triangles")] = None
    """Split the triangles of objects, without changing the surface, until the scene has this many;
    scenes with more stay as they are."""
    num_views: Annotated[int, Within(1, 1000, unit="cameras")] = 4
    """Cameras of every scene."""
    placement: PlacementSettings = field(default_factory=PlacementSettings)
    """How objects are put into the room."""
    materials: MaterialSettings = field(default_factory=MaterialSettings)
    """Materials of objects, floor and walls."""
    lights: LightSettings = field(default_factory=LightSettings)
    """Emitters of the scenes."""
    cameras: CameraSettings = field(default_factory=CameraSettings)
    """Cameras of the scenes."""
    views: ViewLaws = field(default_factory=ViewLaws)
    """What a view must show."""
    excursions: tuple[Excursion, ...] = ()
    """Where given, scenes leave the ranges above along one axis each, in turn."""

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        names = [family.name for family in self.families]
        require(len(set(names)) == len(names), "families", names, "unique names")
        self._check_budget()
        for excursion in self.excursions:
            self._after(excursion)

    def of_scene(self, scene_index: int) -> "SceneSettings":
        """Return what a scene is drawn from: these settings, changed by its excursion if any."""
        excursion = self.excursion_of(scene_index)
        return self if excursion is None else self._after(excursion)

    def excursion_of(self, scene_index: int) -> Excursion | None:
        """Return the excursion of a scene; they take turns."""
        return self.excursions[scene_index % len(self.excursions)] if self.excursions else None

    def _after(self, excursion: Excursion) -> "SceneSettings":
        plain = dataclasses.replace(self, excursions=())
        return changed(plain, dict(excursion.changes))

    def _check_budget(self) -> None:
        for family in self.families:
            lights, objects = self.lights.count[1], family.num_objects[1]
            least = family.shell_triangles + lights + 4 * objects
            require(
                self.max_triangles >= least,
                "max_triangles",
                self.max_triangles,
                f"at least {least} for {family.name}: a shell of {family.shell_triangles}, "
                f"{lights} emitters, and four triangles for each of {objects} objects",
            )
        fits = self.fill_to is None or self.fill_to <= self.max_triangles
        require(fits, "fill_to", self.fill_to, "at most max_triangles")
