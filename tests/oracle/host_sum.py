"""A sum of passes in numpy's memory: what the sums of the kernel are compared with."""

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.tracer import Chosen, Tracer


class HostSum:
    """A `PassSum` in numpy's memory, for a tracer that returns its passes there anyway."""

    def __init__(self, tracer: Tracer, camera: Camera) -> None:
        self._tracer, self._camera = tracer, camera
        self._total = np.zeros((camera.resolution, camera.resolution, 3))
        self._squares = np.zeros((camera.resolution, camera.resolution))

    def add(self, *, seed: int, spp: int, chosen: Chosen = None) -> None:
        means = self._tracer.radiance(self._camera, seed=seed, spp=spp, chosen=chosen)
        mean = means.astype(np.float64)
        self._total += spp * mean
        self._squares += spp * np.square(mean.mean(axis=-1))

    def guide(self) -> None:
        """Do nothing: other tracers are not guided."""

    def read(self) -> NDArray[np.float64]:
        return self._total[None].copy()

    def read_squares(self) -> NDArray[np.float64]:
        return self._squares.copy()
