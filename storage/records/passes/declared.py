"""The passes, declared once: name, channels, unit, frame, how they are averaged, how computed."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from storage.conventions import in_camera, pixel_places
from storage.errors import TrilightError, expected_one_of
from storage.raycast import MISS, FirstHits, corner_table
from storage.records.material import laid_out
from storage.records.scene import Scene


@dataclass(frozen=True, eq=False)
class Later:
    """Another moment of a scene, or another camera, that `motion_px` leads to."""

    scene: Scene
    """Has the same triangles with their corners in the same order, possibly elsewhere."""
    view: int

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] positions in metres, the last row NaN."""
        return corner_table(self.scene, self.scene.vertex_positions)


@dataclass(frozen=True, kw_only=True, eq=False)
class PassRays:
    """Rays of a view, with what they meet."""

    hits: FirstHits
    c2w: NDArray[np.float64]
    """[4, 4] of the camera."""
    fov_deg: float
    resolution: int
    """Width and height of the picture in pixels, however many rays a pixel has."""
    later: Later | None


def motion_px(rays: PassRays) -> NDArray[np.float64]:
    """Return where the other camera shows the points that rays meet, less where this one does.

    That is x to the right and y down [..., 2] in pixels; NaN where nothing is met or where the
    point lies behind the other camera.
    """
    if rays.later is None:
        raise TrilightError("motion_px: no other moment is given; expected `then` or `then_view`.")
    later_scene = rays.later.scene
    view = rays.later.view
    places = pixel_places(
        rays.hits.interpolate(rays.later.corners),
        later_scene.c2w[view],
        float(later_scene.fov_deg[view]),
        rays.resolution,
    )
    return places - pixel_places(rays.hits.position, rays.c2w, rays.fov_deg, rays.resolution)


Frame = Literal["", "world", "camera", "picture"]
"""Axes of a vector. World and camera are those of storage.conventions (a camera looks along -Z with
+Y up); in a picture x runs to the right and y down."""

Averaging = Literal["centre ray", "surfaces", "pixel"]
"""What a pixel holds. `centre ray`: what the ray through its centre meets, never averaged.
`surfaces`: the mean over those of its rays that have a value, which are those that meet a surface;
times `coverage` it is the mean over the whole pixel. `pixel`: the mean over all its rays."""


@dataclass(frozen=True)
class Pass:
    """One picture of what the pixels of a camera see."""

    name: str
    """Lower case letters and underscores, with the unit where there is one."""
    means: str
    of: str | Callable[[PassRays], NDArray] = field(compare=False, repr=False)
    """Name of a quantity of `FirstHits`, or a function of rays: [...] or [..., channels]."""
    averaging: Averaging
    channels: tuple[str, ...] = ()
    """Names of its numbers; a single number has none, and its picture no last axis."""
    unit: str = ""
    frame: Frame = ""
    dtype: type = np.float64
    nothing: float = np.nan
    """Value of pixels that show no surface."""
    short: str = ""
    """A shorter word for it on the command line and in settings."""
    layer: str = ""
    """Name of its layer in OpenEXR files, where other programs have one; by default its own."""

    def at(self, rays: PassRays) -> NDArray:
        """Return the values at rays, [...] or [..., channels]."""
        values: NDArray = getattr(rays.hits, self.of) if isinstance(self.of, str) else self.of(rays)
        return values.astype(self.dtype)

    @property
    def exr_channels(self) -> tuple[str, ...]:
        """Channels in OpenEXR files, one per number.

        A layer's channels have one letter, since programs skip longer names: that of the number in
        upper case, or V for a single value. Z and A are OpenEXR's own names, without a layer.
        """
        if self.layer in _WITHOUT_LAYER:
            return (self.layer,)
        letters = [channel.upper() for channel in self.channels] or ["V"]
        return tuple(f"{self.layer or self.name}.{letter}" for letter in letters)


MOTION = "motion_px"
"""The pass that needs another moment of the scene, or another camera."""

UV = "uv"
"""The pass that only textured scenes have."""

_WITHOUT_LAYER = ("Z", "A")
_XYZ = ("x", "y", "z")
_RGB = ("r", "g", "b")

_at_centre = partial(Pass, averaging="centre ray")
_over_surfaces = partial(Pass, averaging="surfaces")
_row = partial(_at_centre, dtype=np.int32, nothing=MISS)
_depth = partial(_over_surfaces, unit="m", nothing=np.inf)
_vector = partial(_over_surfaces, channels=_XYZ, frame="world")


def _in_camera(name: str) -> Pass:
    """Return the pass of a vector in the axes of the camera."""
    return _over_surfaces(
        f"{name}_camera",
        f"The pass `{name}` in the axes of the camera.",
        lambda rays: getattr(rays.hits, name) @ rays.c2w[:3, :3],
        channels=_XYZ,
        frame="camera",
    )


PASSES = (
    _row("triangle", "Row of `Scene.faces` of the triangle that is seen.", "triangle"),
    _row("object", "Row of `Scene.objects` of the object that is seen.", "object"),
    _at_centre(
        "barycentric",
        "Shares of the triangle's three corners in the point that is seen, adding up to 1.",
        "barycentric",
        channels=("a", "b", "c"),
    ),
    _at_centre(
        "hit",
        "Whether the ray through the pixel's centre meets a surface.",
        "met",
        dtype=np.bool_,
        nothing=False,
    ),
    Pass(
        "coverage",
        "Share of the pixel's rays that meet a surface.",
        "met",
        averaging="pixel",
        layer="A",
        nothing=0,
    ),
    _depth(
        "depth_axis_m",
        "Distance from the camera's plane to the surface, along the axis of the camera.",
        lambda rays: -in_camera(rays.hits.position, rays.c2w)[..., 2],
        short="depth",
        layer="Z",
    ),
    _depth(
        "depth_ray_m", "Distance from the camera's centre to the surface, along the ray.", "depth_m"
    ),
    _vector(
        "position_m", "Point of the surface.", "position", short="position", layer="P", unit="m"
    ),
    _vector(
        "geometric_normal",
        "Unit normal of the triangle, towards the side from which its corners run "
        "counter-clockwise, even where the other side is seen.",
        "geometric_normal",
        layer="Ng",
    ),
    _in_camera("geometric_normal"),
    _vector(
        "shading_normal",
        "Unit normal interpolated between the triangle's corners and bent by its normal map, not "
        "turned to the camera.",
        "shading_normal",
        short="normal",
        layer="N",
    ),
    _in_camera("shading_normal"),
    _at_centre(
        UV,
        "Texture coordinates of the point that is seen, u to the right and v up; undefined where "
        "the scene has none.",
        "uv",
        channels=("u", "v"),
    ),
    _over_surfaces(
        MOTION,
        "How far the point that is seen moves in the picture until another moment or camera, "
        "whether or not something hides it there; undefined where it is behind that camera.",
        motion_px,
        channels=("x", "y"),
        unit="px",
        frame="picture",
    ),
)
"""All passes but those of material columns."""


def declared_passes() -> tuple[Pass, ...]:
    """Return all passes: PASSES, and one for each declared column of materials.

    Emission is 0 wherever a surface is seen, since emitters are hidden from cameras.
    """
    return PASSES + tuple(
        _over_surfaces(
            f"material_{column.name}",
            column.means,
            partial(_column, part=part),
            short=column.name,
            channels=_channels(column.width, is_colour=column.is_colour),
        )
        for column, part in laid_out()
    )


def pass_names(words: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the passes of one scene that words mean, each once, in their own order.

    Args:
        words: names of passes, or their shorter words.

    Raises:
        TrilightError: there is no such pass, or it needs another moment of the scene.
    """
    passes = [each for each in declared_passes() if each.name != MOTION]
    meant = {word: each.name for each in passes for word in (each.short, each.name) if word}
    selected = set()
    for word in words:
        if word == MOTION:
            raise TrilightError(
                f"pass {word} needs another moment or camera, which a stored scene has not; "
                "expected another pass. Ask trilight.view_passes with `then` or `then_view`."
            )
        if word not in meant:
            raise TrilightError(f"there is no pass {word!r:.60}; {expected_one_of(word, meant)}.")
        selected.add(meant[word])
    return tuple(each.name for each in passes if each.name in selected)


def _channels(width: int, *, is_colour: bool) -> tuple[str, ...]:
    if is_colour:
        return _RGB
    return () if width == 1 else tuple(str(index) for index in range(width))


def _column(rays: PassRays, part: slice) -> NDArray[np.float32]:
    """Return the numbers of a column; of one that is a single number, without the last axis."""
    rows = rays.hits.material
    return rows[..., part.start] if part.stop == part.start + 1 else rows[..., part]
