"""`VectorTracer`: a pass is two compiled kernels (LLVM or CUDA): camera paths and light paths.

The sum over a pixel's samples is a reduction of our own, in a fixed order, and that of the light
paths is one of whole numbers: pictures do not depend on the number of threads. A pass is explicit,
so that raw samples are at hand before denoising.
"""

import copy
import functools
import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.device_memory import own_floats, own_integers, read_back
from pipeline.renders.emission_cone import EmissionCone
from pipeline.renders.emitter_table import EmitterTable
from pipeline.renders.film import Film
from pipeline.renders.guide_cells import GuideCells
from pipeline.renders.guide_learning import learn
from pipeline.renders.guide_table import GuideTable
from pipeline.renders.kernel_parts import KernelParts
from pipeline.renders.kernel_scene import KernelScene
from pipeline.renders.light_kernel import trace_light
from pipeline.renders.path_kernel import trace
from pipeline.renders.photon_kernel import PhotonRecords, trace_photons
from pipeline.renders.sky_share import shining_sky, sky_share
from pipeline.renders.sky_table import SkyTable
from pipeline.renders.splats import Splats, splat_unit
from pipeline.renders.textured_table import surface_table
from pipeline.renders.tracer import Chosen, Features, split_triangles
from storage.records.scene import Scene
from storage.seeds import seed_for

LIGHT_PATHS = 0.25
"""Light paths for each camera path: a quarter has most of the gain, and the whole then takes 1.1 to
1.4 times as long (study S5)."""

PHOTON_PATHS = 1 << 19
"""Light paths from which path guiding learns a scene: 0.3 core-seconds. Four times as many made
raw pictures at most 0.4 dB better."""

_PHOTON_SEED = 0

_GOLDEN = 1.1673039782614187
"""The root of x^5 = x + 1, for points that fill four dimensions."""


class VectorTracer:
    """A scene on the LLVM or CUDA backend; see `Tracer` for the meaning of its methods."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int, scale: float = 1) -> None:
        """Load a scene that is `scale` times as large as cameras take it for."""
        surfaces, emitters = split_triangles(scene)
        order = np.concatenate([surfaces, emitters])
        self._record, self._emitters, self._scale = scene, emitters, scale
        seen, sky = _load(scene, surfaces), shining_sky(scene)
        self._scene = KernelScene(
            surfaces=seen,
            everything=_load(scene, order, beside=seen),
            table=surface_table(scene, order),
            emitters=EmitterTable(scene, emitters, may_be_dark=sky is not None),
            cone=EmissionCone(scene),
            num_surfaces=len(surfaces),
            max_depth=max_depth,
            rr_depth=rr_depth,
            sky=None if sky is None else SkyTable(sky, sky_share(scene, sky)),
        )
        self._parts = KernelParts(bounces=False, lobes=False)
        self._unit = splat_unit(scene)
        self._guide = functools.cache(functools.partial(_learnt, scene, self._scene))

    def only_light(self, row: int) -> "VectorTracer":
        lit = self._record.object_index[self._emitters] == row
        tracer = copy.copy(self)
        tracer._scene = copy.copy(self._scene)
        tracer._scene.emitters = EmitterTable(self._record, self._emitters, lit)
        tracer._scene.sky = None
        return tracer

    def apart(self, *, bounces: bool, lobes: bool) -> "VectorTracer":
        tracer = copy.copy(self)
        tracer._parts = KernelParts(bounces=bounces, lobes=lobes)
        return tracer

    def guided(self) -> "VectorTracer":
        """Return a tracer of the same light that is guided where a mirror lights rough surfaces.

        The first call learns the scene, always the same whatever was traced before. The tracers of
        single lights use the table that was learnt with all of them.
        """
        tracer = copy.copy(self)
        tracer._scene = copy.copy(self._scene)
        tracer._scene.guide = self._guide()
        return tracer

    def radiance(
        self, camera: Camera, *, seed: int, spp: int, chosen: Chosen = None
    ) -> NDArray[np.float32]:
        pixels, picture = _pixels(camera, chosen), dr.zeros(mi.Color3f, camera.resolution**2)
        dr.scatter(picture, sum(self._one_pass(camera, pixels, seed=seed, spp=spp)), pixels)
        return _picture(camera, picture)

    def pass_sum(self, camera: Camera) -> "_DeviceSum":
        return _DeviceSum(self, camera)

    def _film(self, camera: Camera) -> Film:
        return Film(camera.scaled(self._scale))

    def _one_pass(self, camera: Camera, pixels: Any, *, seed: int, spp: int) -> list[Any]:
        """Return the means of some pixels (Color3f) of each part.

        Light paths are as many as for the whole picture, so that the weights of the strategies stay
        the same; what lands in other pixels is dropped. In proportion to the chosen pixels they
        saved 10 to 25 % of the time and lost 0.7 to 1.0 dB in hard views.
        """
        light_paths = LIGHT_PATHS * camera.resolution**2
        traced = self._traced(camera, pixels, light_paths, seed=seed, spp=spp)
        landed = self._landed(camera, light_paths, seed=seed, count=int(light_paths * spp))
        pairs = zip(traced, landed, strict=True)
        return [part + dr.gather(mi.Color3f, light, pixels) for part, light in pairs]

    def _traced(
        self, camera: Camera, pixels: Any, light_paths: float, *, seed: int, spp: int
    ) -> list[Any]:
        """Return the camera paths' share of the light (Color3f), beside so many light paths."""
        sampler = _sampler(pixels, seed, spp)
        film, beside = self._film(camera), dr.opaque(mi.Float, light_paths)
        ray = film.rays(*_jittered(camera, pixels, sampler, spp))
        traced = trace(self._scene, film, self._parts, beside, sampler, ray)
        dr.eval(traced)  # all parts in one kernel
        return [_pixel_means(spp, part) for part in traced]

    def _landed(self, camera: Camera, light_paths: float, *, seed: int, count: int) -> list[Any]:
        """Return the share of the light (Color3f) that `count` light paths find."""
        splats = [Splats(camera.resolution, self._unit) for _ in range(self._parts.num_lobes)]
        beside = dr.opaque(mi.Float, light_paths)
        u = even_numbers(count, seed)
        emitter = self._scene.emitters.sample(mi.Point2f(u[0], u[1]), mi.Bool(True))
        to = mi.Point2f(u[2], u[3])
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed_for(seed, "light paths"), count)
        film, parts = self._film(camera), self._parts
        trace_light(self._scene, film, parts, beside, emitter, to, sampler, splats)
        share = dr.opaque(mi.Float64, light_paths / count)
        return parts.of_indirect([mi.Color3f(total.picture() * share) for total in splats])

    def features(self, camera: Camera, *, spp: int) -> Features:
        ray = self._film(camera).rays(*_on_a_grid(camera, spp))
        hit = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
        active = hit.is_valid()
        normal, lobes = self._scene.table.shading(hit.prim_index, hit.prim_uv, active)
        albedo = dr.select(active, lobes.diffuse + lobes.specular, 0)
        apart = ("diffuse", "specular") if self._parts.num_lobes == 2 else ()

        def mean(values: Any) -> NDArray[np.float32]:
            return _picture(camera, _pixel_means(spp, dr.select(active, values, 0)))

        return Features(
            albedo=_picture(camera, _pixel_means(spp, albedo)),
            normal=mean(normal),
            lobes={name: mean(getattr(lobes, name)) for name in apart},
        )

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        ray = self._film(camera).rays(*_on_a_grid(camera, 1))
        found = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True).is_valid()
        return read_back(found).reshape(camera.resolution, camera.resolution)


class _DeviceSum:
    """A `PassSum` in float64 in the memory of the device, so that no pass waits for Python."""

    def __init__(self, tracer: VectorTracer, camera: Camera) -> None:
        self._tracer, self._camera = tracer, camera
        number = tracer._parts.count
        self._totals = [dr.opaque(mi.Color3d, 0, camera.resolution**2) for _ in range(number)]
        self._squares = dr.opaque(mi.Float64, 0, camera.resolution**2)

    def add(self, *, seed: int, spp: int, chosen: Chosen = None) -> None:
        pixels = _pixels(self._camera, chosen)
        traced = self._tracer._one_pass(self._camera, pixels, seed=seed, spp=spp)
        means: list[Any] = [mi.Color3d(part) for part in traced]
        samples = dr.opaque(mi.Float64, spp)
        for total, part in zip(self._totals, means, strict=True):
            _add(total, part * samples, pixels)
        mean: Any = sum(means)
        _add(self._squares, dr.square((mean.x + mean.y + mean.z) / 3) * samples, pixels)
        dr.eval(self._totals, self._squares)

    def guide(self) -> None:
        self._tracer = self._tracer.guided()

    def read(self) -> NDArray[np.float64]:
        return np.stack([_picture(self._camera, total) for total in self._totals])

    def read_squares(self) -> NDArray[np.float64]:
        return read_back(self._squares).reshape(self._camera.resolution, self._camera.resolution)


def _learnt(record: Scene, scene: KernelScene) -> GuideTable | None:
    """Return the guide of a scene: None where no mirror lights a rough surface."""
    order = np.concatenate(split_triangles(record))
    corners = record.vertex_positions[record.faces[order]]
    cells, records = GuideCells(corners.astype(np.float64)), PhotonRecords(PHOTON_PATHS)
    u = even_numbers(PHOTON_PATHS, _PHOTON_SEED)
    emitter = scene.emitters.sample(mi.Point2f(u[0], u[1]), mi.Bool(True))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed_for(_PHOTON_SEED, "photons"), PHOTON_PATHS)
    trace_photons(scene, cells, emitter, mi.Point2f(u[2], u[3]), sampler, records)
    return learn(cells, records.photons())


def even_numbers(count: int, seed: int) -> list[Any]:
    """Return 4 arrays of `count` uniform numbers (Float, [0, 1)): points that fill 4 dimensions.

    Multiples of the 4 inverse powers of a generalised golden ratio (Roberts 2018), shifted by the
    seed. Any first part of them is spread evenly, so that any count will do.
    """
    lane = dr.arange(mi.UInt32, count)
    numbers = []
    for axis in range(4):
        stride = round(2**32 / _GOLDEN ** (axis + 1))
        shift = dr.opaque(mi.UInt32, 2 * seed_for(seed, "light paths", axis))
        numbers.append(mi.Float((lane * stride + shift) >> 8) * 2.0**-24)
    return numbers


def _load(scene: Scene, triangles: NDArray[np.intp], beside: Any = None) -> Any:
    """Return a mi.Scene of one mesh, whose triangle numbers are places in `triangles`.

    One kernel may trace rays into this scene and into `beside`. On a graphics card all rays of a
    kernel use one OptiX shader binding table, and miss whatever is in another table. A scene that
    has another scene as a child shares its table.
    """
    mesh = mi.Mesh("triangles", len(scene.vertex_positions), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = own_floats(scene.vertex_positions)
    parameters["faces"] = scene.faces[triangles].ravel()
    parameters.update()
    children = {"mesh": mesh} if beside is None else {"mesh": mesh, "beside": beside}
    return mi.load_dict({"type": "scene", **children})


def _pixels(camera: Camera, chosen: Chosen = None) -> Any:
    """Return the numbers of the chosen pixels (UInt32), row by row.

    They are in memory even where they are all: one kernel serves any choice.
    """
    number = camera.resolution**2
    numbers = np.arange(number) if chosen is None else np.flatnonzero(chosen)
    return own_integers(numbers)


def _add(total: Any, values: Any, pixels: Any) -> None:
    """Add to some pixels of an array, each of them once: in no order that could matter."""
    dr.scatter(total, dr.gather(type(total), total, pixels) + values, pixels)


def _sampler(pixels: Any, seed: int, spp: int) -> Any:
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, len(pixels) * spp)
    return sampler


def _pixel_corners(camera: Camera, pixels: Any, spp: int) -> tuple[Any, Any]:
    """Return column and row of each lane's pixel; the samples of a pixel are neighbours."""
    lane = dr.arange(mi.UInt32, len(pixels) * spp)
    pixel = dr.gather(mi.UInt32, pixels, lane // dr.opaque(mi.UInt32, spp))
    width = dr.opaque(mi.UInt32, camera.resolution)
    row = pixel // width
    return mi.Float(pixel - row * width), mi.Float(row)


def _jittered(camera: Camera, pixels: Any, sampler: Any, spp: int) -> tuple[Any, Any]:
    column, row = _pixel_corners(camera, pixels, spp)
    jitter = sampler.next_2d()
    return column + jitter.x, row + jitter.y


def _on_a_grid(camera: Camera, spp: int) -> tuple[Any, Any]:
    """Return column and row of each lane's sample: a regular grid in every pixel."""
    across = dr.opaque(mi.UInt32, math.isqrt(spp))
    sample = dr.arange(mi.UInt32, camera.resolution**2 * spp) % (across * across)
    cell = dr.rcp(mi.Float(across))
    grid_row = sample // across
    column, row = _pixel_corners(camera, _pixels(camera), spp)
    within = mi.Float(sample - grid_row * across), mi.Float(grid_row)
    return column + (within[0] + 0.5) * cell, row + (within[1] + 0.5) * cell


def _pixel_means(spp: int, samples: Any) -> Any:
    """Return the mean over the samples of each pixel, Color3f."""
    dr.eval(samples)  # else each channel's reduction would run the whole kernel again
    sums = mi.Color3f(*(dr.block_sum(channel, spp) for channel in samples))
    return sums / spp  # spp is a power of two: exact


def _picture(camera: Camera, pixels: Any) -> NDArray:
    """Return [R, R, 3] of the pixels of a camera, in numpy's memory."""
    return read_back(pixels).reshape(camera.resolution, camera.resolution, 3)
