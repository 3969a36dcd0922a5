"""`VectorTracer`: all samples of a pass in one compiled kernel (Mitsuba's LLVM variant).

The sum over a pixel's samples is a reduction of our own, in a fixed order: pictures do not depend
on the number of threads. A pass is explicit, so that raw samples are at hand before denoising.
"""

import copy
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.device_memory import own_floats
from pipeline.renders.emitter_table import EmitterTable
from pipeline.renders.path_kernel import KernelScene, trace
from pipeline.renders.surface_table import SurfaceTable
from pipeline.renders.tracer import Features, split_triangles
from storage.conventions import focal_px
from storage.scene import Scene


class VectorTracer:
    """A scene on the LLVM backend; see `Tracer` for the meaning of its methods."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        surfaces, emitters = split_triangles(scene)
        order = np.concatenate([surfaces, emitters])
        self._record, self._emitters = scene, emitters
        self._scene = KernelScene(
            surfaces=_load(scene, surfaces),
            everything=_load(scene, order),
            table=SurfaceTable(scene, order),
            emitters=EmitterTable(scene, emitters),
            num_surfaces=len(surfaces),
            max_depth=max_depth,
            rr_depth=rr_depth,
        )

    def only_light(self, row: int) -> "VectorTracer":
        lit = self._record.object_index[self._emitters] == row
        tracer = copy.copy(self)
        tracer._scene = copy.copy(self._scene)
        tracer._scene.emitters = EmitterTable(self._record, self._emitters, lit)
        return tracer

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> NDArray[np.float32]:
        sampler = _sampler(camera, seed, spp)
        ray = _camera_rays(camera, *_jittered(camera, sampler, spp))
        return _pixel_means(camera, spp, trace(self._scene, sampler, ray))

    def features(self, camera: Camera, *, seed: int, spp: int) -> Features:
        sampler = _sampler(camera, seed, spp)
        ray = _camera_rays(camera, *_jittered(camera, sampler, spp))
        hit = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True)
        active = hit.is_valid()
        normal, lobes = self._scene.table.shading(hit.prim_index, hit.prim_uv, active)
        albedo = dr.select(active, lobes.diffuse + lobes.specular, 0)
        return Features(
            albedo=_pixel_means(camera, spp, albedo),
            normal=_pixel_means(camera, spp, dr.select(active, normal, 0)),
        )

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        column, row = _pixel_corners(camera, 1)
        ray = _camera_rays(camera, column + 0.5, row + 0.5)
        found = self._scene.surfaces.ray_intersect_preliminary(ray, coherent=True).is_valid()
        return np.array(found).reshape(camera.resolution, camera.resolution)


def _load(scene: Scene, triangles: NDArray[np.intp]) -> Any:
    """Return a mi.Scene of one mesh, whose triangle numbers are places in `triangles`."""
    mesh = mi.Mesh("triangles", len(scene.vertex_positions), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = own_floats(scene.vertex_positions)
    parameters["faces"] = scene.faces[triangles].ravel()
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


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


def _camera_rays(camera: Camera, x: Any, y: Any) -> Any:
    """Return rays through points of the picture in pixels: storage.conventions.camera_rays."""
    half = dr.opaque(mi.Float, 0.5 * camera.resolution)
    focal = dr.opaque(mi.Float, float(focal_px(camera.fov_deg, camera.resolution)))
    right, up, backward, origin = (_opaque_vector(camera.c2w[:3, axis]) for axis in range(4))
    direction = right * (x - half) + up * (half - y) - backward * focal
    return mi.Ray3f(mi.Point3f(origin), dr.normalize(direction))


def _opaque_vector(values: NDArray[np.float64]) -> Any:
    """Return a Vector3f that the kernel reads as data, so that each view runs the same kernel."""
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def _pixel_means(camera: Camera, spp: int, samples: Any) -> NDArray[np.float32]:
    """Return the mean over the samples of each pixel, [R, R, 3]."""
    dr.eval(samples)  # else each channel's reduction would run the whole kernel again
    sums = np.stack([np.array(dr.block_sum(channel, spp)) for channel in samples], axis=-1)
    means = (sums / spp).astype(np.float32)  # spp is a power of two: exact
    return means.reshape(camera.resolution, camera.resolution, 3)
