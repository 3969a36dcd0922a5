"""The picture's plane inside a kernel: rays through its pixels, and where points show in it."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import PixelCamera
from storage.conventions import focal_px


class Film:
    """One camera as kernels see it: each view runs the same kernel.

    Not a dataclass: Dr.Jit would take its arrays for variables of a loop.
    """

    def __init__(self, camera: PixelCamera) -> None:
        focal = float(focal_px(camera.fov_deg, camera.resolution))
        self._width = dr.opaque(mi.UInt32, camera.resolution)
        self._half = dr.opaque(mi.Float, 0.5 * camera.resolution)
        self._focal = dr.opaque(mi.Float, focal)
        self._right, self._up, self._backward, origin = (
            _opaque_vector(camera.c2w[:3, axis]) for axis in range(4)
        )
        self.origin = mi.Point3f(origin)
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


def _opaque_vector(values: NDArray[np.float64]) -> Any:
    return mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in values))
