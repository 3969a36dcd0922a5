"""`VectorTracer`: a pass is two compiled kernels (LLVM or CUDA): camera paths and light paths.

The sum over a pixel's samples is a reduction of our own, in a fixed order, and that of the light
paths is one of whole numbers: pictures do not depend on the number of threads. A pass is explicit,
so that raw samples are at hand before denoising.
"""

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.device_memory import own_floats, read_back
from pipeline.renders.emission_cone import EmissionCone
from pipeline.renders.emitter_table import EmitterTable
from pipeline.renders.film import Film
from pipeline.renders.kernel_scene import KernelScene
from pipeline.renders.light_kernel import trace_light
from pipeline.renders.path_kernel import trace
from pipeline.renders.splats import Splats, splat_unit
from pipeline.renders.surface_table import SurfaceTable
from pipeline.renders.tracer import Features, split_triangles
from storage.records.scene import Scene
from storage.seeds import seed_for

LIGHT_PATHS = 0.25
"""Light paths for each camera path: a quarter has most of the gain, and the whole then takes 1.1 to
1.4 times as long (docs/log)."""

_GOLDEN = 1.1673039782614187
"""The root of x^5 = x + 1, for points that fill four dimensions."""


class VectorTracer:
    """A scene on the LLVM or CUDA backend; see `Tracer` for the meaning of its methods."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        surfaces, emitters = split_triangles(scene)
        order = np.concatenate([surfaces, emitters])
        self._record, self._emitters = scene, emitters
        seen = _load(scene, surfaces)
        self._scene = KernelScene(
            surfaces=seen,
            everything=_load(scene, order, beside=seen),
            table=SurfaceTable(scene, order),
            emitters=EmitterTable(scene, emitters),
            cone=EmissionCone(scene),
            num_surfaces=len(surfaces),
            max_depth=max_depth,
            rr_depth=rr_depth,
        )
        self._unit = splat_unit(scene)

    def only_light(self, row: int) -> "VectorTracer":
        lit = self._record.object_index[self._emitters] == row
        tracer = copy.copy(self)
        tracer._scene = copy.copy(self._scene)
        tracer._scene.emitters = EmitterTable(self._record, self._emitters, lit)
        return tracer

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> NDArray[np.float32]:
        return _picture(camera, self._one_pass(camera, seed=seed, spp=spp))

    def pass_sum(self, camera: Camera) -> "_DeviceSum":
        return _DeviceSum(self, camera)

    def _one_pass(self, camera: Camera, *, seed: int, spp: int) -> Any:
        """Return what `radiance` does, as Color3f."""
        light_paths = LIGHT_PATHS * camera.resolution**2
        traced = self._traced(camera, light_paths, seed=seed, spp=spp)
        return traced + self._landed(camera, light_paths, seed=seed, count=int(light_paths * spp))

    def _traced(self, camera: Camera, light_paths: float, *, seed: int, spp: int) -> Any:
        """Return the camera paths' share of the light (Color3f), beside so many light paths."""
        sampler = _sampler(camera, seed, spp)
        film, beside = Film(camera), dr.opaque(mi.Float, light_paths)
        ray = film.rays(*_jittered(camera, sampler, spp))
        return _pixel_means(spp, trace(self._scene, film, beside, sampler, ray))

    def _landed(self, camera: Camera, light_paths: float, *, seed: int, count: int) -> Any:
        """Return the share of the light (Color3f) that `count` light paths find."""
        splats, beside = Splats(camera.resolution, self._unit), dr.opaque(mi.Float, light_paths)
        u = even_numbers(count, seed)
        emitter = self._scene.emitters.sample(mi.Point2f(u[0], u[1]), mi.Bool(True))
        to = mi.Point2f(u[2], u[3])
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed_for(seed, "light paths"), count)
        trace_light(self._scene, Film(camera), beside, emitter, to, sampler, splats)
        return mi.Color3f(splats.picture() * dr.opaque(mi.Float64, light_paths / count))

    def features(self, camera: Camera, *, seed: int, spp: int) -> Features:
        sampler = _sampler(camera, seed, spp)
        ray = Film(camera).rays(*_jittered(camera, sampler, spp))
        hit = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
        active = hit.is_valid()
        normal, lobes = self._scene.table.shading(hit.prim_index, hit.prim_uv, active)
        albedo = dr.select(active, lobes.diffuse + lobes.specular, 0)
        return Features(
            albedo=_picture(camera, _pixel_means(spp, albedo)),
            normal=_picture(camera, _pixel_means(spp, dr.select(active, normal, 0))),
        )

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        column, row = _pixel_corners(camera, 1)
        ray = Film(camera).rays(column + 0.5, row + 0.5)
        found = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True).is_valid()
        return read_back(found).reshape(camera.resolution, camera.resolution)


class _DeviceSum:
    """A `PassSum` in float64 in the memory of the device, so that no pass waits for Python."""

    def __init__(self, tracer: VectorTracer, camera: Camera) -> None:
        self._tracer, self._camera = tracer, camera
        self._total = dr.opaque(mi.Color3d, 0, camera.resolution**2)

    def add(self, *, seed: int, spp: int) -> None:
        samples: Any = mi.Color3d(self._tracer._one_pass(self._camera, seed=seed, spp=spp))
        self._total += samples * dr.opaque(mi.Float64, spp)
        dr.eval(self._total)

    def read(self) -> NDArray[np.float64]:
        return _picture(self._camera, self._total)


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


def _sampler(camera: Camera, seed: int, spp: int) -> Any:
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    sampler.set_samples_per_wavefront(spp)
    sampler.seed(seed, camera.resolution**2 * spp)
    return sampler


def _pixel_corners(camera: Camera, spp: int) -> tuple[Any, Any]:
    """Return column and row of each lane's pixel; the samples of a pixel are neighbours."""
    lane = dr.arange(mi.UInt32, camera.resolution**2 * spp)
    pixel = lane // dr.opaque(mi.UInt32, spp)
    width = dr.opaque(mi.UInt32, camera.resolution)
    row = pixel // width
    return mi.Float(pixel - row * width), mi.Float(row)


def _jittered(camera: Camera, sampler: Any, spp: int) -> tuple[Any, Any]:
    column, row = _pixel_corners(camera, spp)
    jitter = sampler.next_2d()
    return column + jitter.x, row + jitter.y


def _pixel_means(spp: int, samples: Any) -> Any:
    """Return the mean over the samples of each pixel, Color3f."""
    dr.eval(samples)  # else each channel's reduction would run the whole kernel again
    sums = mi.Color3f(*(dr.block_sum(channel, spp) for channel in samples))
    return sums / spp  # spp is a power of two: exact


def _picture(camera: Camera, pixels: Any) -> NDArray:
    """Return [R, R, 3] of the pixels of a camera, in numpy's memory."""
    return read_back(pixels).reshape(camera.resolution, camera.resolution, 3)
