"""The camera paths and the light paths of `VectorTracer` apart, as tracers of their own."""

from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.camera import Camera
from pipeline.renders.vector_tracer import VectorTracer
from storage.records.scene import Scene

_ALMOST_ALL = 2.0**40
"""Light paths for each camera path, of which weights leave a millionth to the other strategies."""


class CameraPathsOnly(VectorTracer):
    """The path tracer as it is without light paths."""

    def _one_pass(self, camera: Camera, pixels: Any, *, seed: int, spp: int) -> list[Any]:
        return self._traced(camera, pixels, 0.0, seed=seed, spp=spp)


class CameraPathsLeft(VectorTracer):
    """What weights leave to camera paths beside light paths without number."""

    def _one_pass(self, camera: Camera, pixels: Any, *, seed: int, spp: int) -> list[Any]:
        return self._traced(camera, pixels, _ALMOST_ALL, seed=seed, spp=spp)


class LightPathsOnly(VectorTracer):
    """All light but the direct one from light paths alone, with a weight of 1."""

    def __init__(self, scene: Scene, *, max_depth: int, rr_depth: int) -> None:
        super().__init__(scene, max_depth=max_depth, rr_depth=rr_depth)
        self._unit /= 2.0**32  # each of so many paths counts for so much less

    def _one_pass(self, camera: Camera, pixels: Any, *, seed: int, spp: int) -> list[Any]:
        count = camera.resolution**2 * spp
        landed = self._landed(camera, _ALMOST_ALL, seed=seed, count=count)
        return [dr.gather(mi.Color3f, part, pixels) for part in landed]
