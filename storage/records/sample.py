"""A sample: one scene with its pictures, as the members that it takes in a shard.

    000000123.scene.safetensors   the arrays of the scene; with `.gz` in the profile `compact`
    000000123.json                schema version, objects, provenance, one record per view
    000000123.0.exr ...           linear radiance of each view, half-float RGB OpenEXR
    000000123.0.lights.exr ...    optional: each light's part of it (storage.records.lights)
    000000123.0.parts.exr ...     optional: direct, indirect, ... light (storage.records.lights)
    000000123.0.passes.exr ...    optional: what its pixels see (storage.records.passes)
    __map-<sha256>__ ...          textures and environment map, where the scene has any: once in a
                                  shard, before the first sample (storage.records.packed_maps)

How both are packed is `storage.records.profiles`. The key is everything before the first dot, as
WebDataset reads names.
"""

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from storage.digests import canonical_json
from storage.errors import TrilightError
from storage.raycast import require_row
from storage.records.exr import FIRST_ILLEGAL, Stored, decode_exr, decode_stored, to_float32
from storage.records.lights import (
    ALL_LIGHT,
    KNOWN_PARTS,
    Parts,
    decode_parts_exr,
    encode_parts_exr,
    light_sources,
)
from storage.records.packed_maps import packed_maps, unpacked_maps
from storage.records.passes import picture_passes
from storage.records.profiles import Profile, pack_arrays, pack_picture, unpack_arrays
from storage.records.retextured import without_constant_textures
from storage.records.scene import Scene
from storage.records.scene_file import (
    SceneJson,
    decode_arrays,
    encode_arrays,
    read_scene_record,
    scene_record,
)
from storage.settings.ranges import Law, Within

Plausible = Annotated[float, Within(-1000, 1000, low_open=True, high_open=True)]
"""Number within bounds beyond any stated error in dB and any share."""


@dataclass(frozen=True, kw_only=True)
class PictureErrors:
    """Errors of a picture, of one layer of it for all lights together, or of one light."""

    noise_floor_db: Plausible
    """Error in dB, as psnr_log_db (storage.metrics)."""
    noise_floor_linear_db: Plausible
    """The same error as psnr_linear_db."""
    object_noise_floor_db: Plausible
    """The same error as object_psnr_log_db: over pixels that show geometry."""

    @property
    def rounded(self) -> dict[str, float]:
        """The three errors by name, to a thousandth: as records and headers state them."""
        names = [field.name for field in dataclasses.fields(PictureErrors)]
        return {name: round(getattr(self, name), 3) for name in names}


@dataclass(frozen=True)
class KnownParts(Law):
    """Law of the floors of parts: one of the sets that there are, in the order of their sum."""

    expected: str = f"floors of {'; '.join(', '.join(names) for names in KNOWN_PARTS)}"

    def require(self, value: Any) -> Any:
        if tuple(sorted(value)) not in KNOWN_PARTS:
            raise ValueError(self.expected)
        return dict(sorted(value.items()))


@dataclass(frozen=True, kw_only=True)
class ViewRecord(PictureErrors):
    """Sampling and stated errors of one picture.

    They are measured before it is packed; the profile `compact` adds at most a tenth to their mean
    square (storage.records.profiles).
    """

    spp: int
    """Samples per pixel that were spent; on each light where they are apart."""
    coverage: Plausible
    """Share of the picture in which an object is seen first, from a coarse grid of rays."""
    at_cap: bool
    """True: sampling hit the sample limit before the target error."""
    seed: int
    camera_attempt: int
    """Number of cameras that were rejected before this one."""
    expected: PictureErrors | None = None
    """Errors that are as often better as worse, where the stated errors are calibrated bounds; a
    record whose floors are bounds by estimate and allowances is written without this field."""
    parts: Annotated[Mapping[str, PictureErrors], KnownParts()] | None = None
    """Floors of the parts that are stored, by name (storage.records.lights); a record that has none
    is written without this field."""
    lights: tuple[PictureErrors, ...] | None = None
    """Floors of the lights that are stored, in their order (storage.records.lights); absent where
    they are together, and from older sets."""


def error_text(view: ViewRecord) -> str:
    """Return the stated error of a view and the expected one, as `38.2 dB, probably 40.5`."""
    probably = "" if view.expected is None else f", probably {view.expected.noise_floor_db:.1f}"
    return f"{view.noise_floor_db:.1f} dB{probably}"


@dataclass(frozen=True, kw_only=True)
class SampleJson(SceneJson):
    """Record of a sample: what is no array and no picture of it, as JSON."""

    views: tuple[ViewRecord, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneRecord:
    """A sample without its pictures: all that counting and plotting need."""

    key: str
    """The scene's index, nine digits."""
    scene: Scene
    views: tuple[ViewRecord, ...]
    """One record per camera, in their order."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample(SceneRecord):
    """One scene with its views."""

    radiance_rgb: NDArray[np.float32]
    """[C, R, R, 3] linear radiance, one picture per camera of the scene."""
    lights_rgb: NDArray[np.float32] | None = None
    """[C, L, R, R, 3] radiance of each emitter object alone, in the order of `scene.objects`, and
    last of a sky that shines; their sum is the picture (storage.records.lights). None where the
    preset keeps lights together."""
    parts_rgb: Parts | None = None
    """[C, R, R, 3] radiance of each part by its name, or [C, L, R, R, 3] where lights are apart;
    their sum is the picture, or that of the light (storage.records.lights). None where the preset
    keeps all light together."""
    passes_exr: tuple[bytes, ...] | None = None
    """OpenEXR files of the passes that the preset stores, one per camera; `view_passes` reads them.
    None where the preset stores none."""
    kept_members: Mapping[str, bytes] = dataclasses.field(default_factory=dict)
    """Packed pictures by suffix that stay as another dataset has them, byte for byte."""

    def view_passes(self, names: Sequence[str], *, view: int = 0) -> dict[str, NDArray]:
        """Return passes of one view by name, at the resolution of its picture, one ray a pixel.

        Those that are stored are read, others are computed; the numbers are the same. Names are
        those of storage.records.passes, other than `motion_px`.

        Returns:
            for each name a picture [R, R], or [R, R, K] where the pass has K channels, row 0 on
            top: int32 for ids, bool for `hit`, float32 for all others. Where nothing is met, ids
            are -1, depths infinite, and all others NaN.

        Raises:
            TrilightError: there is no such pass or view, or what is stored is unreadable.
        """
        require_row("view", view, self.scene.num_views)
        with name_errors(f"{self.key}: view {view}"):
            return picture_passes(
                self.scene,
                names,
                view=view,
                resolution=self.radiance_rgb.shape[2],
                stored=None if self.passes_exr is None else self.passes_exr[view],
            )

    def check(self) -> None:
        """Raise TrilightError at the first broken law of what can be learnt from, named by key.

        Scene.check, as many square pictures and records as cameras, and radiance that is finite
        and not negative: one value that is not would reach every weight in one step.
        """
        require_lawful(self)
        count, height, width = self.radiance_rgb.shape[:3]
        views = self.scene.num_views
        if not (count == views and height == width > 0):
            raise TrilightError(
                f"sample {self.key}: {count} pictures of {height} x {width} pixels; expected "
                f"{views}, as many as cameras, square."
            )
        check_radiance(self.key, "", self.radiance_rgb)
        if self.lights_rgb is not None:
            check_radiance(self.key, "", self.lights_rgb)
        for part, pictures in (self.parts_rgb or {}).items():
            check_radiance(self.key, f" {part} light", pictures)


def sample_key(scene_index: int) -> str:
    """Return the key of a scene: its index in nine digits, so that names sort as numbers."""
    return f"{scene_index:09d}"


def encode_sample(sample: Sample, profile: Profile = "lossless") -> dict[str, bytes]:
    """Return the members of a sample by suffix; equal samples give equal bytes.

    A sample that was read from the profile `compact` and is packed so again loses once more: what
    is to stay goes into `kept_members`. Where lights or parts are apart, pictures stay exact in
    every profile: they are the sum of these. It raises TrilightError for a picture that half floats
    cannot hold (storage.records.exr).
    """
    scene = without_constant_textures(sample.scene)
    views = [
        {name: value for name, value in dataclasses.asdict(view).items() if value is not None}
        for view in sample.views
    ]
    record = {**scene_record(scene), "views": views}
    members = pack_arrays(encode_arrays(scene), profile) | {"json": canonical_json(record)}
    together = sample.lights_rgb is None and sample.parts_rgb is None
    of_pictures = profile if together else "lossless"
    for view, (picture, made) in enumerate(zip(sample.radiance_rgb, sample.views, strict=True)):
        members[f"{view}.exr"] = pack_picture(picture, made.noise_floor_db, of_pictures)
    lights = {} if sample.lights_rgb is None else {ALL_LIGHT: sample.lights_rgb}
    for what, parts in (("lights", lights), ("parts", sample.parts_rgb or {})):
        for view in range(len(sample.views)) if parts else ():
            of_view = {name: pictures[view] for name, pictures in parts.items()}
            members[f"{view}.{what}.exr"] = encode_parts_exr(of_view)
    for view, packed in enumerate(sample.passes_exr or ()):
        members[f"{view}.passes.exr"] = packed
    return {**members, **packed_maps(scene), **sample.kept_members}


def decode_sample(key: str, members: Mapping[str, bytes]) -> Sample:
    """Return the sample of its members (suffix to bytes).

    Raises:
        TrilightError: a member is missing, unreadable or of another schema version. Laws are not
            checked here; `Sample.check` does that before a network learns from it.
    """
    record = decode_scene(key, members)
    with name_errors(key):
        every = range(len(record.views))
        radiance_rgb = np.stack([decode_exr(members[f"{view}.exr"]) for view in every])
        size = radiance_rgb.shape[1:3]
        lights = _decode_parts("lights", (ALL_LIGHT,), every, size, record.scene, members)
        names = tuple(record.views[0].parts or ())
        lit = record.scene if lights else None
        return Sample(
            **vars(record),
            radiance_rgb=radiance_rgb,
            lights_rgb=lights.get(ALL_LIGHT),
            parts_rgb=_decode_parts("parts", names, every, size, lit, members) or None,
            passes_exr=_of_views("passes", every, members),
        )


def _of_views(
    what: str, views: Sequence[int], members: Mapping[str, bytes]
) -> tuple[bytes, ...] | None:
    """Return the members `<view>.<what>.exr`; None where the sample has none of any view."""
    if not any(suffix.endswith(f".{what}.exr") for suffix in members):
        return None
    return tuple(members[f"{view}.{what}.exr"] for view in views)


def _decode_parts(
    what: str,
    names: Sequence[str],
    views: Sequence[int],
    size: tuple[int, ...],
    scene: Scene | None,
    members: Mapping[str, bytes],
) -> dict[str, NDArray[np.float32]]:
    """Return what the members `<view>.<what>.exr` hold of some views; nothing where there are none.

    `scene` is None where lights are together. It raises KeyError for a member that is missing, and
    as `decode_parts_exr`.
    """
    packed = _of_views(what, views, members)
    if packed is None:
        return {}
    height, width = size
    num_lights = None if scene is None else len(light_sources(scene))
    by_view = [decode_parts_exr(data, names, (height, width), num_lights) for data in packed]
    return {name: np.stack([of_view[name] for of_view in by_view]) for name in names}


def decode_scene(key: str, members: Mapping[str, bytes]) -> SceneRecord:
    """Return a sample without its pictures, whose members may be absent.

    The maps that its record names are among the members, under the names that shards give them.

    Raises:
        TrilightError: as `decode_sample`.
    """
    if "json" not in members:
        raise TrilightError(f"sample {key}: member {key}.json is missing.")
    with name_errors(key):
        record = read_scene_record(members["json"], SampleJson, f"member {key}.json")
        maps = record.maps
        fields = {} if maps is None else unpacked_maps(maps, members)
        fields |= decode_arrays(unpack_arrays(members), maps)
        return SceneRecord(key=key, scene=record.scene(**fields), views=record.views)


@contextlib.contextmanager
def name_errors(key: str) -> Iterator[None]:
    """Name the sample in what the block raises of its members: each is a TrilightError then."""
    try:
        yield
    except KeyError as error:
        raise TrilightError(f"sample {key}: {error} is missing.") from error
    except (TypeError, ValueError) as error:
        raise TrilightError(f"sample {key}: {error}") from error


def require_lawful(record: SceneRecord) -> None:
    """Raise TrilightError, which names the sample, for a broken law or a view without record."""
    with name_errors(record.key):
        record.scene.check()
    if record.scene.num_views != len(record.views):
        raise TrilightError(
            f"sample {record.key}: {len(record.views)} records of views; expected "
            f"{record.scene.num_views}, one for each camera."
        )


def check_radiance(
    key: str, which: str, radiance_rgb: NDArray[np.float32], *, first_view: int = 0
) -> None:
    """Raise TrilightError, which names the pixel, where radiance is not finite or below 0.

    Args:
        key: of the sample.
        which: part of its pictures, behind a space; empty for all light.
        radiance_rgb: pictures [C, R, R, 3], or [C, L, R, R, 3] of lights apart.
        first_view: number of the first of them.
    """
    if radiance_rgb.min() >= 0 and radiance_rgb.max() < math.inf:  # NaN is neither
        return
    wrong = np.argwhere(~(np.isfinite(radiance_rgb) & (radiance_rgb >= 0)))[0].tolist()
    view, *lights, row, column, _ = wrong
    light = f" light {lights[0]}" if lights else ""
    raise TrilightError(
        f"sample {key}: view {first_view + view}{light}{which} has radiance "
        f"{radiance_rgb[tuple(wrong)]} at pixel ({row}, {column}); expected finite values from 0. "
        "Run `trilight verify` on the dataset."
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredSample(SceneRecord):
    """One scene, which passes `Scene.check`, whose pictures stay packed until they are asked for.

    A training step looks at two of a scene's four views or more, and unpacking a picture takes
    longer than all else that is done to it. What is asked for obeys the same laws as a whole
    sample's (`Sample.check`); of the other pictures nothing is said.
    """

    members: Mapping[str, bytes]
    """Bytes of the sample's members in the shard, by suffix."""

    def pictures(self, views: Sequence[int]) -> Stored:
        """Return the pictures of some views [V, R, R, 3], at least one, as they are stored.

        Bits of half floats, uint16, each below FIRST_ILLEGAL; float32 where one is stored so. It
        raises TrilightError where one is missing, unreadable, not square, of another size than the
        others, or holds a radiance that is not finite or below 0.
        """
        with name_errors(self.key):
            pictures = [decode_stored(self.members[f"{view}.exr"]) for view in views]
        if any(picture.dtype == np.float32 for picture in pictures):
            pictures = [to_float32(picture) for picture in pictures]
        shapes = {picture.shape for picture in pictures}
        if len(shapes) > 1 or any(height != width for height, width, _ in shapes):
            sizes = ", ".join(sorted(f"{height} x {width}" for height, width, _ in shapes))
            raise TrilightError(
                f"sample {self.key}: pictures of {sizes} pixels; expected squares of one size."
            )
        for view, picture in zip(views, pictures, strict=True):
            if picture.dtype == np.float32 or picture.max() >= FIRST_ILLEGAL:
                check_radiance(self.key, "", to_float32(picture)[None], first_view=view)
        stacked: NDArray = np.stack(pictures)
        if stacked.dtype == np.uint16:  # the only legal one that is not below it is -0
            stacked[stacked >= FIRST_ILLEGAL] = 0
        return stacked

    def lights_rgb(self, views: Sequence[int], resolution: int) -> NDArray[np.float32] | None:
        """Return radiance of each light alone [V, L, R, R, 3]; None where they are together.

        Args:
            views: at least one.
            resolution: R, that of `pictures`.

        Raises:
            TrilightError: as `pictures`.
        """
        with name_errors(self.key):
            size = (resolution, resolution)
            lights = _decode_parts("lights", (ALL_LIGHT,), views, size, self.scene, self.members)
        for view, of_view in zip(views, lights.get(ALL_LIGHT, ()), strict=bool(lights)):
            check_radiance(self.key, "", of_view[None], first_view=view)
        return lights.get(ALL_LIGHT)


def stored_sample(key: str, members: Mapping[str, bytes]) -> StoredSample:
    """Return the sample of its members, whose pictures stay packed.

    Raises:
        TrilightError: its scene or record is missing, unreadable or breaks a law, or it has not as
            many records of views, and pictures, as cameras.
    """
    record = decode_scene(key, members)
    require_lawful(record)
    suffixes = (f"{view}.exr" for view in range(len(record.views)))
    if missing := [suffix for suffix in suffixes if suffix not in members]:
        raise TrilightError(f"sample {key}: {missing[0]!r} is missing.")
    return StoredSample(**vars(record), members=members)
