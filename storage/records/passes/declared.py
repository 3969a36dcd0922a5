"""The passes, declared once: name, channels, unit, frame, how they are averaged, how computed."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from storage.conventions import in_camera
from storage.errors import TrilightError, expected_one_of
from storage.raycast.caster import MISS
from storage.records.material import laid_out
from storage.records.passes.rays import PassRays, motion_px

Frame = Literal["", "world", "camera", "picture"]
"""Axes of a vector. World and camera are those of storage.conventions (a camera looks along -Z with
+Y up); in a picture x runs to the right and y down."""

Averaging = Literal["centre ray", "surfaces", "pixel"]
"""What a pixel holds. `centre ray`: what the ray through its centre meets, never averaged.
`surfaces`: the mean over those of its rays that have a value, which are those that meet a surface;
times `coverage` it is the mean over the whole pixel. `pixel`: the mean over all its rays."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """One picture of what the pixels of a camera see."""

    name: str
    """Lower case letters and underscores, with the unit where there is one."""
    means: str
    """One sentence that documents the pass."""
    channels: tuple[str, ...]
    """Names of its numbers; a single number has none, and its picture no last axis."""
    averaging: Averaging
    unit: str = ""
    frame: Frame = ""
    dtype: type = np.float64
    nothing: float = np.nan
    """Value of pixels that show no surface."""
    short: str = ""
    """A shorter word for it on the command line and in settings."""
    layer: str = ""
    """Name of its layer in OpenEXR files, where other programs have one; by default its own."""
    of: Callable[[PassRays], NDArray] = field(compare=False, repr=False)
    """Returns the values at rays, [...] or [..., channels]."""

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

PASSES = (
    Pass(
        name="triangle",
        means="Row of `Scene.faces` of the triangle that is seen.",
        channels=(),
        averaging="centre ray",
        dtype=np.int32,
        nothing=MISS,
        of=lambda rays: rays.hits.triangle,
    ),
    Pass(
        name="object",
        means="Row of `Scene.objects` of the object that is seen.",
        channels=(),
        averaging="centre ray",
        dtype=np.int32,
        nothing=MISS,
        of=lambda rays: rays.hits.object,
    ),
    Pass(
        name="barycentric",
        means="Shares of the triangle's three corners in the point that is seen, adding up to 1.",
        channels=("a", "b", "c"),
        averaging="centre ray",
        of=lambda rays: rays.hits.barycentric,
    ),
    Pass(
        name="hit",
        means="Whether the ray through the pixel's centre meets a surface.",
        channels=(),
        averaging="centre ray",
        dtype=np.bool_,
        nothing=False,
        of=lambda rays: rays.hits.met,
    ),
    Pass(
        name="coverage",
        layer="A",
        means="Share of the pixel's rays that meet a surface.",
        channels=(),
        averaging="pixel",
        nothing=0,
        of=lambda rays: rays.hits.met,
    ),
    Pass(
        name="depth_axis_m",
        short="depth",
        layer="Z",
        means="Distance from the camera's plane to the surface, along the axis of the camera.",
        channels=(),
        averaging="surfaces",
        unit="m",
        nothing=np.inf,
        of=lambda rays: -in_camera(rays.hits.position, rays.c2w)[..., 2],
    ),
    Pass(
        name="depth_ray_m",
        means="Distance from the camera's centre to the surface, along the ray.",
        channels=(),
        averaging="surfaces",
        unit="m",
        nothing=np.inf,
        of=lambda rays: rays.hits.depth_m,
    ),
    Pass(
        name="position_m",
        short="position",
        layer="P",
        means="Point of the surface.",
        channels=_XYZ,
        averaging="surfaces",
        unit="m",
        frame="world",
        of=lambda rays: rays.hits.position,
    ),
    Pass(
        name="geometric_normal",
        layer="Ng",
        means="Unit normal of the triangle, towards the side from which its corners run "
        "counter-clockwise, even where the other side is seen.",
        channels=_XYZ,
        averaging="surfaces",
        frame="world",
        of=lambda rays: rays.hits.geometric_normal,
    ),
    Pass(
        name="geometric_normal_camera",
        means="The pass `geometric_normal` in the axes of the camera.",
        channels=_XYZ,
        averaging="surfaces",
        frame="camera",
        of=lambda rays: rays.hits.geometric_normal @ rays.c2w[:3, :3],
    ),
    Pass(
        name="shading_normal",
        short="normal",
        layer="N",
        means="Unit normal interpolated between the triangle's corners and bent by its normal map, "
        "not turned to the camera.",
        channels=_XYZ,
        averaging="surfaces",
        frame="world",
        of=lambda rays: rays.hits.shading_normal,
    ),
    Pass(
        name="shading_normal_camera",
        means="The pass `shading_normal` in the axes of the camera.",
        channels=_XYZ,
        averaging="surfaces",
        frame="camera",
        of=lambda rays: rays.hits.shading_normal @ rays.c2w[:3, :3],
    ),
    Pass(
        name=UV,
        means="Texture coordinates of the point that is seen, u to the right and v up; undefined "
        "where the scene has none.",
        channels=("u", "v"),
        averaging="centre ray",
        of=lambda rays: rays.hits.uv,
    ),
    Pass(
        name=MOTION,
        means="How far the point that is seen moves in the picture until another moment or camera, "
        "whether or not something hides it there; undefined where it is behind that camera.",
        channels=("x", "y"),
        averaging="surfaces",
        unit="px",
        frame="picture",
        of=motion_px,
    ),
)
"""All passes but those of material columns."""

MATERIAL = "material_"
"""What the name of a column's pass begins with."""


def declared_passes() -> tuple[Pass, ...]:
    """Return all passes: PASSES, and one for each declared column of materials.

    Emission is 0 wherever a surface is seen, since emitters are hidden from cameras.
    """
    return PASSES + tuple(
        Pass(
            name=MATERIAL + column.name,
            short=column.name,
            means=column.means,
            channels=_channels(column.width, is_colour=column.is_colour),
            averaging="surfaces",
            of=partial(_column, part=part),
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
