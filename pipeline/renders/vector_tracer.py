"""`VectorTracer`: path tracing in two compiled kernels (LLVM or CUDA), without `mi.render()`.

One kernel traces paths from the camera, one from the lights.

The sum over a pixel's samples is a reduction of our own, in a fixed order, and that of the light
paths is one of whole numbers: pictures do not depend on the number of threads. A pass is explicit,
so that raw samples are at hand before denoising.
"""

import copy
import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.device_memory import KernelInputs, own_integers, read_back, record_launches
from pipeline.renders.film import Film, Splats, SplatUnit
from pipeline.renders.guide_table import GuideCells, GuideTable, PhotonRecords, learn
from pipeline.renders.kernel_scene import KernelParts, KernelScene, hit_of
from pipeline.renders.light_tables import EmitterTable, SkyTable
from pipeline.renders.path_kernel import join_to_cameras, trace, trace_light
from pipeline.renders.tracer import Chosen, PixelCamera, split_triangles
from storage.denoiser import Features
from storage.records.lights import shining_sky
from storage.records.scene import Scene
from storage.seeds import seed_for

_MOST_PIXELS = 1 << 23
"""Pixels of pictures that wait to be asked for: 100 MB. Beyond them each view traces its own."""


class LandedLight:
    """Pictures of light paths of a scene that wait for the view that they belong to.

    A path takes more than twice as long to trace as to join to a camera. So views whose light paths
    have the same seed are joined to them together: those that wait get pictures that they may not
    need. What a view gets does not depend on that, to the last bit: each picture has its own sums
    of whole numbers (pipeline.renders.film). Errors of the views of a scene are then correlated.
    Those of each view are what they were: it has as many light paths, its halves share none, and
    what it asks for does not depend on other views.
    """

    def __init__(self, cameras: Sequence[PixelCamera] = ()) -> None:
        """Begin with the cameras of the views that will be asked for."""
        self._waiting = {_view_name(camera): camera for camera in cameras}
        self._kept = dict[tuple[Hashable, Hashable], Any]()

    def take(
        self,
        camera: PixelCamera,
        paths: Hashable,
        land: Callable[[Sequence[PixelCamera]], Sequence[Any]],
    ) -> Any:
        """Return the picture of a view, once; those of views that were asked for before it go.

        Args:
            paths: what tells these light paths from others.
            land: returns the picture of each of some cameras.
        """
        self._waiting.pop(_view_name(camera), None)
        names = {_view_name(camera), *self._waiting}
        self._kept = {key: picture for key, picture in self._kept.items() if key[0] in names}
        picture = self._kept.pop((_view_name(camera), paths), None)
        if picture is not None:
            return picture
        waiting = self._waiting
        pixels = camera.resolution**2
        if (len(self._kept) + len(waiting)) * pixels > _MOST_PIXELS:
            waiting = {}
        pictures = iter(land([camera, *waiting.values()]))
        picture = next(pictures)
        self._kept |= {(name, paths): each for name, each in zip(waiting, pictures, strict=True)}
        return picture


def _view_name(camera: PixelCamera) -> Hashable:
    return camera.c2w.tobytes(), camera.fov_deg, camera.resolution


LIGHT_PATHS = 0.25
"""Light paths for each camera path: a quarter has most of the gain, and the whole then takes 1.1 to
1.4 times as long (study S5)."""

PHOTON_PATHS = 1 << 19
"""Light paths from which path guiding learns a scene: 0.3 core-seconds. Four times as many made
raw pictures at most 0.4 dB better."""

_PHOTON_SEED = 0

_GOLDEN = 1.1673039782614187
"""The root of x^5 = x + 1, for points that fill four dimensions."""


_Loaded = TypeVar("_Loaded", "VectorTracer", KernelScene)


class VectorTracer:
    """One loaded scene, on the LLVM or CUDA backend.

    Emitters are hidden from camera rays in everything that it returns.
    """

    _light_paths = LIGHT_PATHS
    """Light paths for each camera path, as weights have it."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int, scale: float = 1) -> None:
        """Load a scene that is `scale` times as large as cameras take it for."""
        self._record = scene
        self._scale = scale
        self._scene = KernelScene(scene, max_depth=max_depth, rr_depth=rr_depth)
        for _ in range(2):  # which arrays of Mitsuba's are one is settled by the first replay
            _settle(KernelInputs(self._scene))
        self._parts = KernelParts(bounces=False, lobes=False)
        self._unit = SplatUnit(scene)
        self._guide = functools.cache(functools.partial(_learn_guide, scene, self._scene))
        self._landed = LandedLight()

    def only_light(self, row: int | None) -> "VectorTracer":
        """Return the same loaded scene in which only the emitter `objects[row]` is switched on.

        The others stay where they are, black, and an environment is off; None leaves only that on.
        Equal seeds give equal camera rays in both.

        Raises:
            Rejected: "unlit_scene" where it has no area.
        """
        _, emitters = split_triangles(self._record)
        lit = self._record.object_index[emitters] == (-1 if row is None else row)
        sky = shining_sky(self._record) if row is None else None
        table = EmitterTable(self._record, emitters, lit, may_be_dark=sky is not None)
        light = {"emitters": table, "sky": None if sky is None else SkyTable(sky, 1.0)}
        return _with_fields(self, _scene=_with_fields(self._scene, **light))

    def split_lights(self, *, bounces: bool, lobes: bool) -> "VectorTracer":
        """Return the same loaded scene, whose sums of passes are by part.

        Args:
            bounces: keep direct and indirect light apart.
            lobes: keep the diffuse and the specular lobe of the visible surface apart.
        """
        return _with_fields(self, _parts=KernelParts(bounces=bounces, lobes=lobes))

    def for_views(self, cameras: Sequence[PixelCamera]) -> "VectorTracer":
        """Return the same loaded scene, which traces light paths of one seed once for all views.

        Args:
            cameras: of the views, in the order in which they will be asked for.
        """
        return _with_fields(self, _landed=LandedLight(cameras))

    def with_guide(self) -> "VectorTracer":
        """Return the same tracer with a guide where a mirror lights rough surfaces.

        The first call learns the scene, always the same whatever was traced before. The tracers of
        single lights use the table that was learnt with all of them.
        """
        return _with_fields(self, _scene=_with_fields(self._scene, guide=self._guide()))

    def radiance(self, camera: PixelCamera, *, seed: int, spp: int) -> NDArray[np.float32]:
        """Return the mean of one pass of samples, linear radiance [R, R, 3].

        Equal arguments give equal bits, whatever the number of threads.

        Args:
            camera: the view.
            seed: 31 bits; passes with different seeds are independent.
            spp: samples per pixel, a square of a power of two.
        """
        samples = self.pass_sum(camera)
        samples.add(seed=seed, spp=spp)
        means = [mi.Color3f(total / spp) for total in samples.sums[:-3]]  # a power of two: exact
        return _picture(camera, sum(means))

    def pass_sum(self, camera: PixelCamera) -> "DeviceSum":
        return DeviceSum(self, camera)

    def _film(self, camera: PixelCamera) -> Film:
        return Film(camera, self._scale)

    def _light(self, camera: PixelCamera, seed: int | None, spp: int) -> Any:
        """Return the light (Color3f) of each lobe that paths of a seed throw on a whole picture.

        Without a seed it is the unit of the light that is to be traced with the camera paths.
        """
        if seed is None:
            return self._unit

        def land_on(cameras: Sequence[PixelCamera]) -> list[list[Any]]:
            numbers = _PassNumbers(camera, seed, spp, self._light_paths)
            films = [self._film(each) for each in cameras]
            inputs = KernelInputs(self._scene, films, self._parts, self._unit, numbers)
            landed: list[list[Any]] = _land(inputs)
            return landed

        return self._landed.take(camera, (seed, spp, self._scene.guide is not None), land_on)

    def features(self, camera: PixelCamera, *, spp: int) -> Features:
        """Return the albedo and normal pictures, of `spp` evenly spread rays in each pixel."""
        albedo, normal = self.guides(camera, (), spp=spp)[""]
        return Features(albedo=_picture(camera, albedo), normal=_picture(camera, normal))

    def guides(
        self, camera: PixelCamera, names: Sequence[str], *, spp: int
    ) -> dict[str, tuple[Any, Any]]:
        """Return `features` by the name of a part in the device's memory (Float, flat); "" is all.

        A lobe is guided by its own albedo, and by no normal where it has none: there it is black.
        """
        inputs = KernelInputs(self._scene, self._film(camera), self._parts)
        of_lobes: dict[str, tuple[Any, Any]] = _features(inputs, camera.resolution, spp)
        every = of_lobes[""]
        return {name: of_lobes.get(name.partition("_")[0], every) for name in ("", *names)}

    def hits(self, camera: PixelCamera) -> NDArray[np.bool_]:
        """Return whether the ray through each pixel's centre hits a surface, [R, R]."""
        return read_back(self.hit_array(camera)).reshape(camera.resolution, camera.resolution)

    def hit_array(self, camera: PixelCamera) -> Any:
        """Return `hits` in the memory of the device (Bool)."""
        return _hits(KernelInputs(self._scene, self._film(camera)), camera.resolution)


def _with_fields(loaded: _Loaded, **fields: Any) -> _Loaded:
    """Return a shallow copy with other values of some fields."""
    copied = copy.copy(loaded)
    vars(copied).update(fields)
    return copied


class _PassNumbers:
    """The numbers of a pass, as kernels read them: its size, seeds, and how many light paths."""

    def __init__(self, camera: PixelCamera, seed: int, spp: int, light_paths: float) -> None:
        """Take the numbers of a seed; weights have `light_paths` for each camera path."""
        light_paths *= camera.resolution**2
        self.resolution = camera.resolution
        self.spp = spp
        self.count = int(LIGHT_PATHS * camera.resolution**2 * spp)
        self.camera_seed = dr.opaque(mi.UInt32, seed)
        self.light_seed = dr.opaque(mi.UInt32, seed_for(seed, "light paths"))
        self.shifts = even_shifts(seed)
        self.light_paths = dr.opaque(mi.Float, light_paths)
        self.share = dr.opaque(mi.Float64, light_paths / self.count)


def land(
    scene: Any, films: Sequence[Film], parts: Any, unit: SplatUnit, numbers: _PassNumbers
) -> list[list[Any]]:
    """Return the light (Color3f) of each lobe that light paths throw on each picture."""
    splats = [[Splats(numbers.resolution, unit) for _ in range(parts.num_lobes)] for _ in films]
    record = functools.partial(join_to_cameras, films, parts, numbers.light_paths, splats)
    _trace_light_paths(scene, numbers.light_seed, numbers.shifts, numbers.count, record)
    return [
        [mi.Color3f(total.picture() * numbers.share) for total in of_film] for of_film in splats
    ]


def _trace_light_paths(scene: Any, seed: Any, shifts: list[Any], count: int, record: Any) -> None:
    """Trace light paths of a seed, which begin evenly on all emitters (`trace_light`)."""
    u = even_numbers(count, shifts)
    emitter = scene.emitters.sample(mi.Point2f(u[0], u[1]), mi.Bool(True))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    trace_light(scene, emitter, mi.Point2f(u[2], u[3]), sampler, record)


_land = record_launches(land)


@record_launches
def _add_pass(
    scene: Any, film: Any, parts: Any, light: Any, numbers: Any, pixels: Any, sums: list[Any]
) -> list[Any]:
    """Return the sums of `DeviceSum` with those of a pass over some pixels.

    Light of whole pictures that was traced before (Color3f) is added to what camera paths find.
    """
    spp = numbers.spp
    pixel = dr.gather(mi.UInt32, pixels, dr.arange(mi.UInt32, len(pixels) * spp) // spp)
    dr.eval(pixel)  # from its size a replay reads how many lanes there are
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(numbers.camera_seed, len(pixels) * spp)
    jitter = sampler.next_2d()
    (column, row) = film.corners(pixel)
    ray = film.rays(column + jitter.x, row + jitter.y)
    traced = trace(scene, film, parts, numbers.light_paths, sampler, ray)
    dr.eval(traced)  # all parts in one kernel
    means: list[Any] = [_pixel_means(spp, part) for part in traced]
    if not isinstance(light, list):
        (light,) = land(scene, [film], parts, light, numbers)
    gathered = [dr.gather(mi.Color3f, each, pixels) for each in light]
    means = [
        mi.Color3d(part + each)
        for part, each in zip(means, parts.of_indirect(gathered), strict=True)
    ]
    mean: Any = sum(means)
    square = dr.square((mean.x + mean.y + mean.z) / 3)
    new = [*(part * spp for part in means), square * spp, mi.Float64(spp), mi.Float64(1)]
    for total, values in zip(sums, new, strict=True):  # a pixel once: no order could matter
        dr.scatter(total, dr.gather(type(total), total, pixels) + values, pixels)
    dr.eval(sums)
    return sums


@record_launches
def _settle(scene: KernelScene) -> Any:
    return scene.num_surfaces + 1


@record_launches
def _features(
    scene: Any, film: Film, parts: Any, resolution: int, spp: int
) -> dict[str, tuple[Any, Any]]:
    """Return albedo and normal (Float, flat) of all light, "", and of each lobe that is apart."""
    hit, active = _first_hit(scene, film, resolution, spp)
    normal, lobes = scene.table.shading(hit, active)
    mapped = scene.table.mapped_normal(normal, hit, active)
    normal = normal if mapped is None else mapped
    named = {"": lobes.diffuse + lobes.specular}
    if parts.num_lobes == 2:
        named |= {"diffuse": lobes.diffuse, "specular": lobes.specular}
    normal, *albedos = (
        _pixel_means(spp, dr.select(active, values, 0)) for values in (normal, *named.values())
    )
    seen = [normal, *(dr.select(dr.any(each != 0), normal, 0) for each in albedos[1:])]
    pairs = zip(map(dr.ravel, albedos), map(dr.ravel, seen), strict=True)
    return dict(zip(named, pairs, strict=True))


@record_launches
def _hits(scene: Any, film: Film, resolution: int) -> Any:
    _, is_met = _first_hit(scene, film, resolution, 1)
    return is_met


def _first_hit(scene: Any, film: Film, resolution: int, spp: int) -> Any:
    """Return `hit_of` camera rays on a regular grid in every pixel."""
    across = math.isqrt(spp)
    lane = dr.arange(mi.UInt32, resolution**2 * spp)
    sample = lane % spp
    (column, row) = film.corners(lane // spp)
    grid_row = sample // across
    within = mi.Float(sample - grid_row * across), mi.Float(grid_row)
    cell = 1 / across  # a power of two
    ray = film.rays(column + (within[0] + 0.5) * cell, row + (within[1] + 0.5) * cell)
    return hit_of(scene.surfaces.ray_intersect_preliminary(ray, coherent=True))


class DeviceSum:
    """The growing sum of the passes of one view, in float64 in the memory of the device.

    So no pass waits for Python.
    """

    def __init__(self, tracer: VectorTracer, camera: PixelCamera) -> None:
        self._tracer = tracer
        self._camera = camera
        self._film = tracer._film(camera)
        kinds = [*[mi.Color3d] * tracer._parts.count, *[mi.Float64] * 3]
        self.sums: list[Any] = [dr.opaque(kind, 0, camera.resolution**2) for kind in kinds]
        """Sums by pixel: of each part (`split_lights`, Color3d), of samples times squared grey mean
        over the passes, of samples, and of passes (Float64). Grey is the mean of the three channels
        of all parts together; its squares give the spread between passes."""

    def add(
        self, *, seed: int, spp: int, chosen: Chosen = None, light_seed: int | None = None
    ) -> None:
        """Add all samples of one pass, whose pixels have others where others are chosen.

        It may return before they are traced. With `light_seed` its light paths have that seed. They
        are as many as for the whole picture, so that the weights of the strategies stay the same;
        what lands in other pixels is dropped. In proportion to the chosen pixels they saved 10 to
        25 % of the time and lost 0.7 to 1.0 dB in hard views.
        """
        tracer = self._tracer
        camera = self._camera
        numbers = _PassNumbers(camera, seed, spp, tracer._light_paths)
        light = tracer._light(camera, light_seed, spp)
        inputs = KernelInputs(tracer._scene, self._film, tracer._parts, light, numbers)
        pixels = dr.arange(mi.UInt32, camera.resolution**2)
        if chosen is not None:
            pixels = own_integers(np.flatnonzero(chosen))
        dr.eval(pixels)  # in memory even where they are all: one kernel serves any choice
        self.sums = _add_pass(inputs, pixels, self.sums)

    def guide(self) -> None:
        """Let the passes from now on be guided (pipeline.renders.guide_table), if they can be.

        Their expected value stays the same. The first call for a scene learns it.
        """
        self._tracer = self._tracer.with_guide()

    def read(self) -> list[NDArray[np.float64]]:
        """Return `sums`, [R, R, 3] of each part and [R, R] of all else, once they are traced.

        They are not finite where any sample was not, and equal sums of the passes, one by one.
        """
        parts = [_picture(self._camera, total) for total in self.sums[:-3]]
        return [*parts, *(read_back(total).reshape(parts[0].shape[:2]) for total in self.sums[-3:])]


def _learn_guide(record: Scene, scene: KernelScene) -> GuideTable | None:
    """Return the guide of a scene: None where no mirror lights a rough surface."""
    order = np.concatenate(split_triangles(record))
    corners = record.vertex_positions[record.faces[order]]
    cells = GuideCells(corners.astype(np.float64))
    records = PhotonRecords(cells, PHOTON_PATHS)
    seed = seed_for(_PHOTON_SEED, "photons")
    _trace_light_paths(scene, seed, even_shifts(_PHOTON_SEED), PHOTON_PATHS, records)
    return learn(cells, *records.photons())


def even_shifts(seed: int) -> list[Any]:
    """Return the shifts (UInt32) of `even_numbers` that go with a seed."""
    return [dr.opaque(mi.UInt32, 2 * seed_for(seed, "light paths", axis)) for axis in range(4)]


def even_numbers(count: int, shifts: Sequence[Any]) -> list[Any]:
    """Return 4 arrays of `count` uniform numbers (Float, [0, 1)): points that fill 4 dimensions.

    Multiples of the 4 inverse powers of a generalised golden ratio (Roberts 2018), each shifted by
    a number (UInt32). Any first part of them is spread evenly, so that any count will do.
    """
    lane = dr.arange(mi.UInt32, count)
    strides = [round(2**32 / _GOLDEN ** (axis + 1)) for axis in range(4)]
    return [
        mi.Float((lane * stride + shift) >> 8) * 2.0**-24
        for stride, shift in zip(strides, shifts, strict=True)
    ]


def _pixel_means(spp: int, samples: Any) -> Any:
    """Return the mean over the samples of each pixel, Color3f."""
    dr.eval(samples)  # else each channel's reduction would run the whole kernel again
    sums = mi.Color3f(*(dr.block_sum(channel, spp) for channel in samples))
    return sums / spp  # spp is a power of two: exact


def _picture(camera: PixelCamera, pixels: Any) -> NDArray:
    """Return [R, R, 3] of the pixels of a camera, in numpy's memory."""
    return read_back(pixels).reshape(camera.resolution, camera.resolution, 3)
