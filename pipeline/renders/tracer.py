"""`Tracer`: what the renderer asks of Mitsuba, whichever variant runs.

Two of them exist. `VectorTracer` is a path tracer of our own for the LLVM variant. `PluginTracer`
is Mitsuba's stock path integrator: it is what `scalar_rgb` can run, and the independent twin that
the other is tested against. Both estimate the same integral.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from storage.records.scene import Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """What guides the denoiser, averaged over the area of each pixel."""

    albedo: NDArray[np.float32]
    """[R, R, 3] diffuse + specular albedo of the first surface, 0 where there is none."""
    normal: NDArray[np.float32]
    """[R, R, 3] its shading normal in world space, 0 where there is none."""


class PassSum(Protocol):
    """The growing sum of the passes of one view, in the memory where they are traced."""

    def add(self, *, seed: int, spp: int) -> None:
        """Add all samples of one pass: `Tracer.radiance` times `spp`.

        It may return before they are traced.
        """

    def read(self) -> NDArray[np.float64]:
        """Return the sum over all samples, [R, R, 3]; not finite where any sample was not.

        It waits until they are traced, and equals the sum in float64 of the passes, one by one.
        """


class Tracer(Protocol):
    """One loaded scene. Emitters are hidden from camera rays in everything that it returns."""

    def only_light(self, row: int) -> "Tracer":
        """Return the same loaded scene in which only the emitter `objects[row]` is switched on.

        The others stay where they are, black. Equal seeds give equal camera rays in both.

        Raises:
            Rejected: "unlit_scene" where it has no area.
        """

    def radiance(self, camera: Camera, *, seed: int, spp: int) -> NDArray[np.float32]:
        """Return the mean of one pass of samples, linear radiance [R, R, 3].

        Equal arguments give equal bits, whatever the number of threads.

        Args:
            camera: the view.
            seed: 31 bits; passes with different seeds are independent.
            spp: samples per pixel, a square of a power of two.
        """

    def pass_sum(self, camera: Camera) -> PassSum:
        """Return an empty sum of passes of a view."""

    def features(self, camera: Camera, *, seed: int, spp: int) -> Features:
        """Return the albedo and normal pictures."""

    def hits(self, camera: Camera) -> NDArray[np.bool_]:
        """Return whether the ray through each pixel's centre hits a surface, [R, R]."""


class HostSum:
    """A `PassSum` in numpy's memory, for a tracer that returns its passes there anyway."""

    def __init__(self, tracer: Tracer, camera: Camera) -> None:
        self._tracer, self._camera = tracer, camera
        self._total = np.zeros((camera.resolution, camera.resolution, 3))

    def add(self, *, seed: int, spp: int) -> None:
        self._total += spp * self._tracer.radiance(self._camera, seed=seed, spp=spp)

    def read(self) -> NDArray[np.float64]:
        return self._total.copy()


def split_triangles(scene: Scene) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the triangle rows of surfaces and those of emitters."""
    emits = scene.triangle_emits
    return np.flatnonzero(~emits), np.flatnonzero(emits)
