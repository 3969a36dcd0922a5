"""The samples of one view: two growing halves that share nothing, of each light apart or of all."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.tracer import Tracer
from storage.errors import Rejected
from storage.seeds import seed_for


class HalfSamples:
    """Two growing sums of passes of one view, with no sample in common.

    There are P parts: one for all light, or one for each emitter alone. The passes of all parts
    have the same seeds, hence the same camera rays.
    """

    def __init__(self, parts: Sequence[Tracer], camera: Camera, pass_spp: int, seed: int) -> None:
        self._parts, self._camera, self._pass_spp, self._seed = parts, camera, pass_spp, seed
        shape = (len(parts), camera.resolution, camera.resolution, 3)
        self._sums = [np.zeros(shape), np.zeros(shape)]
        self._passes = [0, 0]

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together."""
        return sum(self._passes) * self._pass_spp

    def passes_to(self, spp: int) -> Iterator[None]:
        """Add passes to both halves until there are `spp` samples, yielding after each.

        Raises:
            Rejected: "nonfinite_radiance" where a raw sample is not finite.
        """
        while self.spp < spp:
            for half, total in enumerate(self._sums):
                seed = seed_for(self._seed, "pass", self._passes[half], half)
                for part, tracer in enumerate(self._parts):
                    total[part] += self._one_pass(tracer, seed)
                self._passes[half] += 1
                yield

    def half_means(self) -> list[NDArray[np.float32]]:
        """Return the mean of each half, [P, R, R, 3]."""
        pairs = zip(self._sums, self._passes, strict=True)
        return [(total / passes).astype(np.float32) for total, passes in pairs]

    def mean(self) -> NDArray[np.float32]:
        """Return the mean of all samples, [P, R, R, 3]."""
        return ((self._sums[0] + self._sums[1]) / sum(self._passes)).astype(np.float32)

    def _one_pass(self, tracer: Tracer, seed: int) -> NDArray[np.float32]:
        radiance_rgb = tracer.radiance(self._camera, seed=seed, spp=self._pass_spp)
        if not np.isfinite(radiance_rgb).all():
            count = int((~np.isfinite(radiance_rgb)).any(axis=-1).sum())
            raise Rejected("nonfinite_radiance", f"{count} pixels of raw samples")
        return radiance_rgb
