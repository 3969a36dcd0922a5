"""The samples of one view: two growing halves that share nothing, of each light apart or of all."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.settings import PASS_SPP
from pipeline.renders.tracer import Tracer
from storage.errors import Rejected
from storage.seeds import seed_for


class HalfSamples:
    """Two growing sums of passes of one view, with no sample in common.

    There are P parts: one for all light, or one for each emitter alone. The passes of all parts
    have the same seeds, hence the same camera rays.
    """

    def __init__(
        self, parts: Sequence[Tracer], camera: Camera, seed: int, *, first_spp: int, max_spp: int
    ) -> None:
        """Begin a view without any sample.

        Args:
            parts: what is traced.
            camera: the view.
            seed: of this view alone.
            first_spp: samples per pixel of the first measurement, both halves together.
            max_spp: the most that will be asked for.
        """
        self._seed = seed
        self._first, self._most = first_spp // 2, max_spp // 2
        self._sums = [[part.pass_sum(camera) for part in parts] for _ in range(2)]
        self._read: list[NDArray[np.float64]] = []
        self._half_spp = [0, 0]
        self._passes = 0

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together."""
        return sum(self._half_spp)

    @property
    def pass_spp(self) -> int:
        """Samples per pixel of the next pass of one half: the best that leads to round numbers.

        It divides what is there already and what is left, so that a half which has 64 samples goes
        on in passes of 64, however small its first ones were.
        """
        done = self._half_spp[0]
        left = (self._most if done else self._first) - done
        return next(size for size in PASS_SPP if done % size == 0 and left % size == 0)

    def passes_to(self, spp: int) -> Iterator[None]:
        """Add passes to both halves until there are `spp` samples at least, yielding after each.

        Nothing waits for a pass to be finished before a mean is asked for.
        """
        while self.spp < spp:
            size = self.pass_spp
            for half, parts in enumerate(self._sums):
                seed = seed_for(self._seed, "pass", self._passes, half)
                for part in parts:
                    part.add(seed=seed, spp=size)
                self._half_spp[half] += size
                self._read = []
                yield
            self._passes += 1

    def half_means(self) -> list[NDArray[np.float32]]:
        """Return the mean of each half, [P, R, R, 3]; raises as `mean`."""
        pairs = zip(self._totals(), self._half_spp, strict=True)
        return [(total / spp).astype(np.float32) for total, spp in pairs]

    def mean(self) -> NDArray[np.float32]:
        """Return the mean of all samples, [P, R, R, 3].

        Raises:
            Rejected: "nonfinite_radiance" where a raw sample is not finite.
        """
        first, second = self._totals()
        return ((first + second) / self.spp).astype(np.float32)

    def _totals(self) -> list[NDArray[np.float64]]:
        """Return the sums of both halves, [P, R, R, 3], read back once after each pass."""
        if not self._read:
            totals = [np.stack([part.read() for part in parts]) for parts in self._sums]
            broken = ~np.isfinite(totals).all(axis=(0, 1, -1))
            if broken.any():
                raise Rejected("nonfinite_radiance", f"{broken.sum()} pixels of raw samples")
            self._read = totals
        return self._read
