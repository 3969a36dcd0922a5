"""The picture's plane inside a kernel: rays through its pixels, and light that lands in them.

Any lane adds to any pixel, and the sums are equal in every bit whatever the order. Sums of floats
depend on the order, and threads come in any; sums of whole numbers do not. So a splat is rounded to
a multiple of a unit, a power of two that goes with the scene's brightest emitter: pictures scale
exactly with the light.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from pipeline.renders.device_memory import opaque_vector
from pipeline.renders.tracer import PixelCamera
from storage.conventions import focal_px
from storage.records.material import EMISSION
from storage.records.scene import Scene


class Film:
    """One camera as kernels see it: each view runs the same kernel.

    Not a dataclass: Dr.Jit would take its arrays for variables of a loop.
    """

    def __init__(self, camera: PixelCamera, scale: float = 1) -> None:
        """Take a camera, in a scene that is `scale` times as large as the camera takes it for."""
        focal = float(focal_px(camera.fov_deg, camera.resolution))
        self._width = dr.opaque(mi.UInt32, camera.resolution)
        self._half = dr.opaque(mi.Float, 0.5 * camera.resolution)
        self._focal = dr.opaque(mi.Float, focal)
        self._right, self._up, self._backward = map(opaque_vector, camera.c2w[:3, :3].T)
        self.origin = mi.Point3f(opaque_vector(camera.c2w[:3, 3] * scale))
        """Point3f: the pinhole."""

    def rays(self, x: Any, y: Any) -> Any:
        """Return rays through points of the picture in pixels: storage.conventions.camera_rays."""
        right = self._right * (x - self._half)
        up = self._up * (self._half - y)
        return mi.Ray3f(self.origin, dr.normalize(right + up - self._backward * self._focal))

    def corners(self, pixel: Any) -> tuple[Any, Any]:
        """Return column and row (Float) of pixels (UInt32)."""
        row = pixel // self._width
        return mi.Float(pixel - row * self._width), mi.Float(row)

    def pixel(self, point: Any) -> tuple[Any, Any]:
        """Return the pixel (UInt32) in which a point shows, and whether the picture contains it."""
        local = point - self.origin
        scale = self._focal / -dr.dot(local, self._backward)
        x = self._half + scale * dr.dot(local, self._right)
        y = self._half - scale * dr.dot(local, self._up)
        width = mi.Float(self._width)
        inside = (scale > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < width)
        row = mi.UInt32(dr.select(inside, y, 0))
        column = mi.UInt32(dr.select(inside, x, 0))
        return row * self._width + column, inside

    def pdf(self, direction: Any) -> Any:
        """Return the pixels per steradian (Float) around a unit direction from the pinhole."""
        cosine = -dr.dot(direction, self._backward)
        return dr.square(self._focal) / (cosine * dr.square(cosine))


_STEPS = 34
"""A unit is the radiance of the brightest emitter over 2^33 to 2^34: what is dimmer is lost."""

_LARGEST = 2.0**54
"""A splat in units, a million times that radiance: a thousand of them fit into 64 bits."""

_SMALLEST_EXPONENT = -90
"""Least exponent of the brightest emitter's radiance: units must stay normal float32 numbers."""


class SplatUnit:
    """The radiance of one unit, as kernels read it."""

    def __init__(self, scene: Scene) -> None:
        emission = scene.materials[scene.material_index[scene.triangle_emits], EMISSION]
        brightest = float(emission.max(initial=0))
        exponent = max(math.frexp(brightest)[1], _SMALLEST_EXPONENT) + 1 - _STEPS
        self.value = math.ldexp(0.5, exponent)
        self.radiance = dr.opaque(mi.Float64, self.value)
        """Float64."""
        self.per_radiance = dr.opaque(mi.Float, 1 / self.value)
        """Float: units of radiance 1."""


class Splats:
    """Sums of one picture. Not a dataclass: Dr.Jit would take its arrays for variables of loops."""

    def __init__(self, resolution: int, unit: SplatUnit) -> None:
        """Begin with nothing, in a picture of `resolution` pixels each way."""
        self._unit = unit
        self._sums = [dr.zeros(mi.UInt64, resolution**2) for _ in range(3)]
        self._broken = dr.zeros(mi.UInt32, resolution**2)

    def add(self, value: Any, pixel: Any, active: Any) -> None:
        """Add colours of at least 0 (Color3f) to pixels (UInt32)."""
        # Atomic. By default each thread would sum a picture of its own, in a separate kernel.
        add = dr.ReduceOp.Add
        direct = dr.ReduceMode.Direct
        units = value * self._unit.per_radiance
        fits = dr.max(units) < _LARGEST
        fits &= dr.all(dr.isfinite(units))  # dr.max passes over NaN
        for channel, total in zip(units, self._sums, strict=True):
            rounded = mi.UInt64(dr.select(fits, channel, 0) + 0.5)
            dr.scatter_reduce(add, total, rounded, pixel, active & fits, mode=direct)
        dr.scatter_reduce(add, self._broken, mi.UInt32(1), pixel, active & ~fits, mode=direct)

    def picture(self) -> Any:
        """Return the sums (Color3d), pixel by pixel; NaN where a splat was not finite or too large.

        They stay where the kernels run.
        """
        dr.eval(self._sums, self._broken)
        sums: Any = mi.Color3d(*self._sums)
        sums *= self._unit.radiance
        return dr.select(self._broken > 0, dr.nan, sums)
