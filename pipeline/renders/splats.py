"""Sums over pixels to which any lane adds, equal in every bit whatever the order.

Sums of floats depend on the order, and threads come in any; sums of whole numbers do not. So a
splat is rounded to a multiple of a unit, a power of two that goes with the scene's brightest
emitter: pictures scale exactly with the light.
"""

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from storage.records.material import EMISSION
from storage.records.scene import Scene

_STEPS = 34
"""A unit is the radiance of the brightest emitter over 2^33 to 2^34: what is dimmer is lost."""

_LARGEST = 2.0**54
"""A splat in units, a million times that radiance: a thousand of them fit into 64 bits."""

_SMALLEST_EXPONENT = -90
"""Least exponent of the brightest emitter's radiance: units must stay normal float32 numbers."""


class SplatUnit:
    """The radiance of one unit, as kernels read it."""

    def __init__(self, radiance: float) -> None:
        self.radiance = dr.opaque(mi.Float64, radiance)
        """Float64."""
        self.per_radiance = dr.opaque(mi.Float, 1 / radiance)
        """Float: units of radiance 1."""


def splat_unit(scene: Scene) -> float:
    """Return the radiance of one unit."""
    emission = scene.materials[scene.material_index[scene.triangle_emits], EMISSION]
    brightest = float(emission.max(initial=0))
    return math.ldexp(0.5, max(math.frexp(brightest)[1], _SMALLEST_EXPONENT) + 1 - _STEPS)


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
