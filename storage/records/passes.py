"""Render passes (AOVs): what the pixels of a camera see, as functions of a stored scene.

Each is declared once, in PASSES: name, channels, unit, frame, how it is averaged, how computed. The
rays of a pixel stand on a regular grid over its area, the same for every pixel, so that equal
arguments give equal numbers. Ids and barycentrics are those of one more ray, through the centre.

In OpenEXR files all channels are float32, packed without loss: ids below 2^24 are exact in it, and
Nuke and Blender turn every channel into it anyway. Names of channels are `Pass.exr_channels`. The
channel A, which is the pass `coverage`, is always there. Where it is 0 nothing is met, and the file
holds 0 instead of NaN, since filters of other programs would spread NaN over its neighbours;
readers restore it. For the same reason a scene without textures has no channels of the pass `uv`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from storage.conventions import camera_rays, in_camera, pixel_places
from storage.errors import TrilightError, expected_one_of
from storage.raycast import MISS, FirstHitCaster, FirstHits, SeenFrom, corner_table, require_row
from storage.records.exr import decode_channels, encode_channels, read_header
from storage.records.material import laid_out
from storage.records.scene import Scene


@dataclass(frozen=True, eq=False)
class View:
    """A camera of a scene, and the width of its picture."""

    scene: Scene
    row: int
    """Row of the camera in `scene.c2w`."""
    resolution: int
    """Width and height of the picture in pixels, however many rays a pixel has."""

    @cached_property
    def c2w(self) -> NDArray[np.float64]:
        """[4, 4] of the camera."""
        return self.scene.c2w[self.row].astype(np.float64)

    @cached_property
    def fov_deg(self) -> float:
        """Full field of view in degrees."""
        return float(self.scene.fov_deg[self.row])

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """[T + 1, 3, 3] positions in metres, the last row NaN."""
        return corner_table(self.scene, self.scene.vertex_positions)

    def places(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the picture shows positions, as `pixel_places`."""
        return pixel_places(positions, self.c2w, self.fov_deg, self.resolution)


def motion_px(hits: FirstHits, view: View, later: View | None) -> NDArray[np.float64]:
    """Return where the later picture shows the points that rays meet, less where this one does.

    That is x to the right and y down [..., 2] in pixels; NaN where nothing is met or where the
    point lies behind the other camera. The later scene is another moment, whose triangles have
    their corners in the same order, or this one.
    """
    if later is None:
        raise TrilightError("motion_px: no other moment is given; expected `then` or `then_view`.")
    return later.places(hits.interpolate(later.corners)) - view.places(hits.position)


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
    of: str | Callable[[FirstHits, View, View | None], NDArray] = field(compare=False, repr=False)
    """Name of a quantity of `FirstHits`, or a function as `at`."""
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

    def at(self, hits: FirstHits, view: View, later: View | None) -> NDArray:
        """Return the values [...] or [..., channels] at what rays of a view meet."""
        if isinstance(self.of, str):
            return np.asarray(getattr(hits, self.of), self.dtype)
        return np.asarray(self.of(hits, view, later), self.dtype)

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
        lambda hits, view, _: getattr(hits, name) @ view.c2w[:3, :3],
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
        lambda hits, view, _: -in_camera(hits.position, view.c2w)[..., 2],
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
    passes = list(PASSES)
    for column, part in laid_out():
        channels = _RGB if column.is_colour else tuple(map(str, range(column.width)))
        is_number = column.width == 1
        passes.append(
            _over_surfaces(
                f"material_{column.name}",
                column.means,
                partial(_column, part.start if is_number else part),
                short=column.name,
                channels=() if is_number else channels,
            )
        )
    return tuple(passes)


def _column(at: slice | int, hits: FirstHits, *_: View | None) -> NDArray[np.float32]:
    return hits.material[..., at]


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


BLOCK_RAYS = 2**14
"""Rays that are computed at a time: their numbers stay in the processor's cache."""

MOST_A_SIDE = 64
"""Maximum rays along a side of a pixel."""


def view_passes(
    scene: Scene,
    names: Sequence[str] | None = None,
    *,
    view: int = 0,
    resolution: int = 256,
    rays_a_side: int = 1,
    then: Scene | None = None,
    then_view: int | None = None,
    surfaces: FirstHitCaster | None = None,
) -> dict[str, NDArray]:
    """Return passes of one camera of a scene: pictures of what its pixels see.

    Emitters are hidden from cameras, as in the path traced pictures: rays pass through them.
    `declared_passes` says of each pass what it means, its channels, unit, frame and averaging.

    Args:
        scene: passes `Scene.check`.
        names: of the passes; all by default, `motion_px` and `uv` only where they have a meaning.
        view: row of `scene.c2w`.
        resolution: width and height of the pictures in pixels.
        rays_a_side: passes that are averaged take this number of rays along each side of a pixel,
            1 to 64, its square in all. With 1, everything is exactly what the centre's ray meets.
        then: for `motion_px`: the same triangles at another moment; by default this scene.
        then_view: for `motion_px`: row of the cameras of `then`; by default `view`.
        surfaces: what finds the triangles that cameras of the scene see; by default Embree.

    Returns:
        for each name a picture [R, R], or [R, R, K] where the pass has K channels, row 0 on top:
        int32 for ids, bool for `hit`, float64 for all others. Where nothing is met, ids are -1,
        depths infinite, and all others NaN. Means of normals are shorter than 1 where a pixel sees
        several; means of depths and positions may lie between surfaces.

    Raises:
        TrilightError: there is no such pass or view; a number is out of its range; or `then` has
            other triangles.
    """
    require_row("view", view, scene.num_views)
    _require_whole("resolution", resolution, 2**16)
    _require_whole("rays_a_side", rays_a_side, MOST_A_SIDE)
    now = View(scene, view, resolution)
    later = _later(now, then, then_view)
    without = {UV: scene.uv is None, MOTION: later is None}
    chosen = _select_passes(names, without={name for name, lacks in without.items() if lacks})
    if all(each.averaging == "centre ray" for each in chosen):
        rays_a_side = 1
    seen = SeenFrom(scene, now.c2w[:3, 3], surfaces)
    rows = max(1, BLOCK_RAYS // (resolution * rays_a_side**2))
    blocks = [
        _block(chosen, seen, now, later, range(resolution)[first : first + rows], rays_a_side)
        for first in range(0, resolution, rows)
    ]
    return {each.name: np.concatenate([block[each.name] for block in blocks]) for each in chosen}


def _block(
    chosen: Sequence[Pass], seen: SeenFrom, now: View, later: View | None, rows: range, a_side: int
) -> dict[str, NDArray]:
    """Return passes of some rows of pixels, from one ray in their centres or `a_side` squared."""
    hits = {}
    for count in {1, a_side}:
        lines = slice(rows.start * count, rows.stop * count)
        _, directions = camera_rays(now.c2w, now.fov_deg, now.resolution * count, lines)
        hits[count] = seen.hits(directions)
    return {
        each.name: each.at(hits[1], now, later)
        if each.averaging == "centre ray"
        else _means(each.at(hits[a_side], now, later), a_side, each.nothing)
        for each in chosen
    }


def _means(values: NDArray, a_side: int, nothing: float) -> NDArray:
    """Return the means over squares of rays that have finite values; `nothing` where none has."""
    has_value = np.isfinite(values if values.ndim == 2 else values[..., :1])
    if a_side == 1:
        return np.where(has_value, values, nothing)
    total = _sums(np.where(has_value, values, 0), a_side)
    count = _sums(has_value.astype(np.float64), a_side)
    return np.where(count > 0, total / np.maximum(count, 1), nothing)


def _sums(values: NDArray, a_side: int) -> NDArray:
    """Return the sums over squares of a_side x a_side of the first two axes."""
    rows, columns, *channels = values.shape
    blocks = values.reshape(rows // a_side, a_side, columns // a_side, a_side, *channels)
    return blocks.sum(axis=3).sum(axis=1)


def _select_passes(names: Iterable[str] | None, *, without: Collection[str] = ()) -> list[Pass]:
    known = {each.name: each for each in declared_passes()}
    if names is None:
        return [each for each in known.values() if each.name not in without]
    for name in names:
        if name not in known:
            raise TrilightError(f"there is no pass {name!r:.60}; expected of {', '.join(known)}.")
    return [known[name] for name in dict.fromkeys(names)]


def _later(now: View, then: Scene | None, then_view: int | None) -> View | None:
    """Return the view that `motion_px` leads to; raises TrilightError for other triangles."""
    if then is None and then_view is None:
        return None
    scene = now.scene if then is None else then
    later = View(scene, now.row if then_view is None else then_view, now.resolution)
    require_row("then_view", later.row, scene.num_views)
    faces = now.scene.faces
    if faces.shape != scene.faces.shape:
        raise TrilightError(
            f"motion_px: the other scene has {scene.num_triangles} triangles; expected the "
            f"{now.scene.num_triangles} of this one, in the same order."
        )
    differ = np.flatnonzero((faces != scene.faces).any(axis=1))
    if len(differ):
        row = differ[0]
        raise TrilightError(
            f"motion_px: faces[{row}] of the other scene is {scene.faces[row].tolist()}; expected "
            f"{faces[row].tolist()} as in this one, since points are followed by triangles."
        )
    return later


def _require_whole(name: str, value: int, most: int) -> None:
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise TrilightError(f"{name} is {value}; expected a whole number from 1 to {most}.")


COVERAGE = "coverage"
"""The pass that every file has."""

MOST_IDS = 2**24
"""Float32 holds every whole number up to this one."""


def passes_exr(
    scene: Scene,
    names: Sequence[str],
    *,
    view: int,
    resolution: int,
    rays_a_side: int = 1,
    surfaces: FirstHitCaster | None = None,
) -> bytes:
    """Return the OpenEXR file of passes of one camera; equal arguments give equal bytes.

    Args:
        scene: passes `Scene.check`.
        names: of the passes; `passes_in_file` says which of them the file has.
        view, resolution, rays_a_side, surfaces: as `view_passes`.

    Raises:
        TrilightError: as `view_passes`, or the scene has more than 2^24 triangles.
    """
    if scene.num_triangles > MOST_IDS:
        raise TrilightError(
            f"passes: the scene has {scene.num_triangles} triangles; expected at most {MOST_IDS}, "
            "so that ids are exact in a file."
        )
    pictures = view_passes(
        scene,
        passes_in_file(scene, names),
        view=view,
        resolution=resolution,
        rays_a_side=rays_a_side,
        surfaces=surfaces,
    )
    is_hit = pictures[COVERAGE] > 0
    channels: dict[str, NDArray[np.float32]] = {}
    for each in _select_passes(pictures):
        values = np.atleast_3d(pictures[each.name]).astype(np.float32)
        unmet = np.isnan(values) & ~is_hit[..., None]
        planes = np.where(unmet, np.float32(0), values)
        for number, channel in enumerate(each.exr_channels):
            channels[channel] = np.ascontiguousarray(planes[..., number])
    return encode_channels(channels)


def decode_passes_exr(data: bytes, resolution: int) -> dict[str, NDArray]:
    """Return the passes in a file by name, as `picture_passes`; `coverage` is among them.

    Raises:
        TrilightError: not an EXR file, truncated, of another size, or with channels that are no
            whole passes.
    """
    header = read_header(data)
    stored_channels = {channel.name for channel in header["channels"]}
    passes = [each for each in declared_passes() if stored_channels >= set(each.exr_channels)]
    names = [channel for each in passes for channel in each.exr_channels]
    if COVERAGE not in {each.name for each in passes}:
        raise TrilightError("passes: channel A (coverage) is missing.")
    size = (resolution, resolution)
    channels = decode_channels(data, names, header, size=size, what="passes", separate=True)
    nowhere = channels["A"] == 0
    return {each.name: _restore(each, channels, nowhere) for each in passes}


def picture_passes(
    scene: Scene, names: Sequence[str], *, view: int, resolution: int, stored: bytes | None = None
) -> dict[str, NDArray]:
    """Return passes of one view by name, one ray a pixel: the same numbers, stored or computed.

    Args:
        scene, names, view, resolution: as `view_passes`.
        stored: an OpenEXR file of passes of this view; what it lacks is computed.

    Returns:
        as `view_passes`, with float32 in place of float64.

    Raises:
        TrilightError: as `view_passes` and `decode_passes_exr`.
    """
    pictures = {} if stored is None else decode_passes_exr(stored, resolution)
    lacking = [name for name in names if name not in pictures]
    if lacking:
        computed = view_passes(scene, lacking, view=view, resolution=resolution)
        pictures |= {
            each.name: computed[each.name].astype(_stored_dtype(each))
            for each in _select_passes(computed)
        }
    return {name: pictures[name] for name in names}


def passes_in_file(scene: Scene, names: Sequence[str]) -> list[str]:
    """Return the passes that a file has where `names` are asked for.

    `coverage` is among them; `uv` only where the scene has texture coordinates, so that of a preset
    which mixes textured and plain scenes no file holds NaN where a surface is met.
    """
    known = [name for name in names if name != UV or scene.uv is not None]
    return known if COVERAGE in known else [*known, COVERAGE]


def _stored_dtype(each: Pass) -> type:
    """Return the type of a pass that went through a file."""
    return np.float32 if each.dtype is np.float64 else each.dtype


def _restore(each: Pass, channels: Mapping[str, NDArray], nowhere: NDArray[np.bool_]) -> NDArray:
    planes = [np.asarray(channels[channel], np.float32) for channel in each.exr_channels]
    if np.isnan(each.nothing):
        unmet = nowhere & np.all([plane == 0 for plane in planes], axis=0)
        planes = [np.where(unmet, np.float32(np.nan), plane) for plane in planes]
    picture = np.stack(planes, axis=-1) if each.channels else planes[0]
    return picture.astype(_stored_dtype(each))
