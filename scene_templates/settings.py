"""`SceneSettings`: all settings from which a scene is drawn.

Numbers follow the RenderFormer V1 recipes where they are known and sound; each deviation says why.
The nominal shell is the cube [-0.5, 0.5]^3 in world units. The recipes state some sizes for a cube
of side 2; fields that hold such numbers say so, and the numbers are halved on use.

An excursion takes a scene beyond the usual range along one axis, while all else stays.
"""

import dataclasses
from dataclasses import field
from typing import Annotated, Any, ClassVar, Literal

import pydantic

from scene_templates.checks import OFFSET, require
from scene_templates.families import Family
from scene_templates.placement import PlacementSettings
from scene_templates.sample_camera import CameraSettings
from scene_templates.sample_lights import LightSettings
from scene_templates.sample_material import MaterialSettings
from scene_templates.scene_maps import TextureSettings
from scene_templates.skies.procedural_skies import SkySettings
from storage.settings.described import checked
from storage.settings.overrides import apply_overrides
from storage.settings.ranges import FLOAT32_MAX, Share, Within


@checked("excursion")
class Excursion:
    """One value beyond the usual range, and the settings that produce it."""

    axis: str
    """Name of what varies, such as `fov_deg`; recorded in the provenance of its scenes."""
    value: Annotated[int | float, Within(-FLOAT32_MAX, FLOAT32_MAX)]
    """The value itself; recorded in the provenance too."""
    changes: tuple[tuple[str, Any], ...]
    """Scene settings to change, by dotted name, with their values (storage.settings.overrides)."""


MAX_TRIANGLES = 65_535
"""Materials and objects are counted in 16 bits (storage.records.scene); a triangle may be a
material."""

MIN_TRIANGLES = 129
"""A floor and one emitter."""


@checked("scene settings")
class ViewLaws:
    """Conditions on what a camera sees; a camera that fails one is drawn again."""

    coverage_grid: Annotated[int, Within(1, 256, unit="rays")] = 32
    """Camera rays per side of the square grid with which a view is checked."""
    min_coverage: Share = 0.02
    """Minimum share of the camera rays that hit an object first, in scenes that have objects."""
    min_lit: Share = 0.05
    """Minimum share of the visible surface points that some emitter lights on the visible side, or
    the sky, looked for in eight directions."""
    max_shell_back: Share = 0.1
    """Maximum share of the camera rays that hit a floor or wall from behind."""
    min_depth: Annotated[float, OFFSET] = 0.01
    """Minimum distance from the camera to any surface, and to the bounding box of any object."""


@checked("scene settings")
class SceneSettings:
    """Ranges and shares from which scenes are drawn. Ranges are (low, high), both ends included."""

    families: tuple[Family, ...]
    """Families (a layout with its objects) to draw scenes from, by weight."""
    families_in_turn: bool = False
    """Take the families in turn and ignore their weights, so that each makes the same number of
    scenes."""
    max_triangles: Annotated[int, Within(MIN_TRIANGLES, MAX_TRIANGLES, unit="triangles")] = 1536
    """Maximum number of triangles of a scene, shell and emitters included."""
    enough_error: Share = 0.005
    """Error at which an object gets no more triangles: the 99th percentile of the distance to its
    source, as a share of the diagonal. Half a percent is about a pixel of a picture 256 pixels
    wide; 0 spends the whole budget."""
    centring: Literal["vertex_mean", "box"] = "box"
    """Centre of an object: `box` is the middle of its source's bounding box; `vertex_mean`, as
    published, is the mean of its vertices, which depends on the tessellation."""
    fill_to: Annotated[int | None, Within(1, MAX_TRIANGLES, unit="triangles")] = None
    """Number of triangles up to which those of objects are subdivided, without changing the
    surface; scenes with more stay as they are."""
    num_views: Annotated[int, Within(1, 1000, unit="cameras")] = 4
    """Number of cameras of every scene."""
    placement: PlacementSettings = field(default_factory=PlacementSettings)
    """Placement of objects in the room."""
    materials: MaterialSettings = field(default_factory=MaterialSettings)
    """Materials of objects, floor and walls."""
    textures: TextureSettings = field(default_factory=TextureSettings)
    """Textures of objects, floor and walls."""
    lights: LightSettings = field(default_factory=LightSettings)
    """Emitters of the scenes."""
    cameras: CameraSettings = field(default_factory=CameraSettings)
    """Cameras of the scenes."""
    views: ViewLaws = field(default_factory=ViewLaws)
    """Conditions that every view must meet."""
    skies: SkySettings = field(default_factory=SkySettings)
    """Light from all around; by default there is none."""
    excursions: tuple[Excursion, ...] = ()
    """Values beyond the usual ranges, for tests out of distribution: scenes take these excursions
    in turn, one each."""
    REMOVED: ClassVar = ("strata",)
    """Settings of earlier versions."""

    @pydantic.model_serializer(mode="wrap")
    def _record(self, as_usual: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out textures and skies that there are none of: earlier digests stay."""
        record: dict[str, Any] = as_usual(self)
        for name in ("textures", "skies"):
            if not record[name]["own_share"]:
                del record[name]["own_share"]
        absent = {name for name in ("textures", "skies") if not record[name]["share"]}
        return {name: value for name, value in record.items() if name not in absent}

    def __post_init__(self) -> None:
        require(len(self.families) > 0, "families", self.families, "at least one")
        names = [family.name for family in self.families]
        require(len(set(names)) == len(names), "families", names, "unique names")
        for family in self.families:
            shell = family.shell_triangles
            lights = self.lights.count[1]
            objects = family.num_objects[1]
            least = shell + lights + 4 * objects
            require(
                self.max_triangles >= least,
                "max_triangles",
                self.max_triangles,
                f"at least {least} for {family.name}: a shell of {shell}, {lights} emitters, and "
                f"four triangles for each of {objects} objects",
            )
        fits = self.fill_to is None or self.fill_to <= self.max_triangles
        require(fits, "fill_to", self.fill_to, "at most max_triangles")
        is_lit = self.lights.count[0] > 0 or self.skies.share == 1
        require(is_lit, "lights.count", self.lights.count, "at least 1, or skies.share of 1")
        for excursion in self.excursions:
            self._after(excursion)

    def of_scene(self, scene_index: int) -> "SceneSettings":
        """Return what a scene is drawn from: these settings, changed by its excursion."""
        excursion = self.excursion_of(scene_index)
        return self if excursion is None else self._after(excursion)

    def excursion_of(self, scene_index: int) -> Excursion | None:
        """Return the excursion of a scene; they take turns."""
        return self.excursions[scene_index % len(self.excursions)] if self.excursions else None

    def _after(self, excursion: Excursion) -> "SceneSettings":
        plain = dataclasses.replace(self, excursions=())
        return apply_overrides(plain, dict(excursion.changes))
