"""`SceneSettings`: every range from which a scene is drawn, with its published origin.

Numbers follow the RenderFormer V1 recipes where they are known and sound; each deviation says why.
World units throughout: the nominal shell is the cube [-0.5, 0.5]^3, so sizes that the recipes
state for a cube of side 2 are halved on use (fields that hold such numbers say "before halving").
"""

import dataclasses
import math
from dataclasses import dataclass

from storage.errors import TrilightError

Range = tuple[float, float]

SHARES = (
    "square_share",
    "resting_share",
    "smooth_share",
    "coloured_share",
    "min_coverage",
    "min_lit",
    "max_shell_back",
)
"""Fields that are shares of something, and so at most 1."""

SHELL_TRIANGLES = {"plane": 128, "wall": 256, "corner": 384, "open_box": 512}
"""The layouts that exist, and the triangles of their shells: 128 for the floor and each wall."""


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """What scenes are drawn from. Ranges are (low, high), both ends included."""

    templates: tuple[str, ...] = tuple(SHELL_TRIANGLES)
    """Layouts to draw from, with equal weight; a name given twice weighs double."""
    max_triangles: int = 1536
    """Most triangles of a whole scene, shell and emitters included."""
    num_views: int = 4
    """Cameras of every scene."""

    square_share: float = 0.5
    """Share of scenes whose floor and walls are exact rectangles of one room, edge to edge."""
    room_scale: Range = (1.0, 1.35)
    """Size of the room per axis, before halving; shared by its parts, so that they meet."""
    room_shift: float = 0.05
    """How far the room is moved sideways at most, before halving."""
    room_raise: Range = (-0.05, 0.25)
    """How far the room is raised, before halving: no fixed height of the floor to learn."""
    shell_tilt_deg: float = 3.0
    """Most tilt of a floor or wall out of its plane, in rooms that are not square. The recipes
    allow 10 for open layouts and 3 for the box; parts tilted by 10 must be half as large again
    for their seams to stay closed."""

    num_objects: tuple[int, int] = (1, 3)
    """Fewest and most objects, each count equally likely."""
    single_object_scale: Range = (1.2, 2.2)
    """Diameter of the bounding sphere of an object that is alone, before halving. A size that
    does not fit between the walls of a small room is drawn again."""
    object_scale: Range = (0.8, 1.8)
    """The same for an object among others. Where no place without overlap is found, all sizes are
    drawn again: the mean of three objects is 1.04 to 1.1 instead of 1.3."""
    resting_share: float = 0.5
    """Share of objects that rest on the floor; the others float."""

    num_lights: tuple[int, int] = (1, 8)
    """Fewest and most emitters, each count equally likely."""
    total_emission: Range = (2500.0, 5000.0)
    """Radiance summed over the emitters: one of n emits a number from this range divided by n."""
    light_scale: Range = (2.0, 2.5)
    """Scale per axis of the emitter triangle (edge 0.0707), which is not halved."""
    light_distance: Range = (2.1, 2.7)
    """Distance of an emitter from a point near the origin (see `target_jitter`)."""
    light_spacing: float = 0.3
    """Least distance between two emitters as seen from the origin, on a sphere of radius 0.866."""

    albedo_sum: Range = (0.9, 1.0)
    """Diffuse scale plus specular of a surface."""
    roughness_log: Range = (0.06, 1.055)
    """Range whose logarithm is drawn evenly; `roughness_bias` is then taken off."""
    roughness_bias: float = 0.05
    """See `roughness_log`; makes smooth surfaces common without a pile at the smallest value."""
    roughness_clip: Range = (0.01, 1.0)
    """Least and greatest roughness."""
    smooth_share: float = 0.5
    """Share of objects and shell parts with interpolated normals; the others are flat."""
    coloured_share: float = 0.5
    """Share of the smooth ones that have many colours: per triangle on the shell, per shading
    group on objects."""
    smooth_angle_deg: float = 30.0
    """An edge sharper than this separates shading groups."""

    camera_distance: Range = (1.5, 2.0)
    """From the camera to the point it looks at."""
    target_jitter: float = 0.2
    """Most offset per axis from the origin of what a camera looks at or an emitter hangs around."""
    up_jitter: float = 0.1
    """Most offset per axis of a camera's up vector from +Z."""
    fov_deg: Range = (30.0, 60.0)
    """Full field of view, horizontal and vertical."""

    coverage_grid: int = 32
    """Camera rays per side with which a view is judged."""
    min_coverage: float = 0.02
    """Least share of the camera rays that meet an object first."""
    min_lit: float = 0.05
    """Least share of what the camera sees that some emitter shines upon, on the side seen."""
    max_shell_back: float = 0.1
    """Greatest share of the camera rays that meet a floor or wall from behind."""
    min_depth: float = 0.01
    """Least distance from the camera to anything, and to the bounding box of any object."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check_numbers(field.name, getattr(self, field.name))
        _check_templates(self.templates)
        _check_counts(self)
        _check_ranges(self)


def _check_ranges(settings: SceneSettings) -> None:
    for name in SHARES:
        share = getattr(settings, name)
        _require(share <= 1, name, share, "a share in [0, 1]")
    for name in ("albedo_sum", "roughness_clip"):
        bounds = getattr(settings, name)
        _require(bounds[1] <= 1, name, bounds, "a range within [0, 1]")
    _require(settings.fov_deg[1] < 180, "fov_deg", settings.fov_deg, "degrees below 180")
    tilt_deg = settings.shell_tilt_deg
    _require(tilt_deg <= 10, "shell_tilt_deg", tilt_deg, "at most 10 degrees")
    lowest = settings.roughness_log[0] - settings.roughness_bias
    _require(lowest >= 0, "roughness_bias", settings.roughness_bias, "at most roughness_log's low")


def _check_numbers(name: str, value: object) -> None:
    """Check that numbers are finite and from 0, and ranges in order and (but one) above 0."""
    if name == "templates":
        return
    if not isinstance(value, tuple):
        usable = isinstance(value, int | float) and math.isfinite(value) and value >= 0
        _require(usable, name, value, "a finite number from 0")
        return
    low, high = value
    _require(math.isfinite(low) and math.isfinite(high), name, value, "finite numbers")
    _require(low <= high, name, value, "the lower number first")
    if name != "room_raise":
        _require(low > 0, name, value, "numbers above 0")


def _check_templates(templates: tuple[str, ...]) -> None:
    known = ", ".join(SHELL_TRIANGLES)
    _require(len(templates) > 0, "templates", templates, f"some of {known}")
    for name in templates:
        _require(name in SHELL_TRIANGLES, "templates", name, f"one of {known}")


def _check_counts(settings: SceneSettings) -> None:
    for name in ("num_views", "coverage_grid"):
        count = getattr(settings, name)
        _require(isinstance(count, int) and count > 0, name, count, "a whole number above 0")
    for name in ("num_objects", "num_lights"):
        counts = getattr(settings, name)
        whole = all(isinstance(count, int) for count in counts)
        _require(whole, name, counts, "two whole numbers")
    shell = max(SHELL_TRIANGLES[name] for name in settings.templates)
    least = shell + settings.num_lights[1] + settings.num_objects[1]
    _require(
        settings.max_triangles >= least,
        "max_triangles",
        settings.max_triangles,
        f"at least {least}: a shell of {shell}, {settings.num_lights[1]} emitters, and a triangle "
        "for each object",
    )


def _require(law: bool, name: str, value: object, expected: str) -> None:
    if not law:
        raise TrilightError(f"scene settings: {name} is {value!r}; expected {expected}.")
