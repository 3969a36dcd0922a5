"""The samples of one view: two growing halves that share nothing, of each light apart or of all."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import Camera
from pipeline.renders.kept_light import LEAST_PASSES
from pipeline.renders.settings import PASS_SPP
from pipeline.renders.tracer import Chosen, Tracer
from storage.errors import Rejected
from storage.seeds import seed_for


class HalfSamples:
    """Two growing sums of passes of one view, with no sample in common.

    There are P pictures: those of one tracer of all light, or those of the tracers of each emitter
    alone, one after another. The passes of all tracers have the same seeds, hence the same camera
    rays.
    """

    def __init__(
        self, tracers: Sequence[Tracer], camera: Camera, seed: int, *, first_spp: int, max_spp: int
    ) -> None:
        """Begin a view without any sample.

        Args:
            tracers: what is traced.
            camera: the view.
            seed: of this view alone.
            first_spp: samples per pixel of the first measurement, both halves together.
            max_spp: the most that will be asked for.
        """
        self._seed = seed
        self._first, self._most = first_spp // 2, max_spp // 2
        self._sums = [[tracer.pass_sum(camera) for tracer in tracers] for _ in range(2)]
        self._read: list[NDArray[np.float64]] = []
        self._squares: list[NDArray[np.float64]] = []
        self._spp, self._count = np.zeros((2, 2, camera.resolution, camera.resolution), np.int64)
        self._passes = 0
        self.counted = np.ones(self._spp.shape[1:], bool)
        """[R, R] the pixels over which `spp` is a mean."""

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together: the mean over the counted pixels."""
        return int(self._spp.sum(axis=0).mean(where=self.counted))

    def spp_of(self, half: int) -> NDArray[np.int64]:
        """Return the samples of each pixel in one half, [R, R]."""
        return self._spp[half]

    @property
    def pass_spp(self) -> int:
        """Samples per pixel of the next pass of one half: the best that leads to round numbers.

        It divides what is there already and what is left, so that a half which has 64 samples goes
        on in passes of 64, however small its first ones were.
        """
        done = int(self._spp[0].max())
        left = (self._most if done else self._first) - done
        return next(size for size in PASS_SPP if done % size == 0 and left % size == 0)

    def passes_to(self, spp: int) -> Iterator[None]:
        """Add passes to both halves until there are `spp` samples at least, yielding after each.

        Nothing waits for a pass to be finished before a mean is asked for.
        """
        while self.spp < spp:
            size = self.pass_spp
            for half in range(2):
                self._add(half, size, None)
                yield
            self._passes += 1

    def passes_over(self, more: Sequence[NDArray[np.int64]]) -> Iterator[None]:
        """Add the best passes to some pixels, yielding after each.

        Args:
            more: for each half, how many more of them each pixel gets, [R, R].
        """
        for number in range(max(int(passes.max()) for passes in more)):
            for half, passes in enumerate(more):
                if (passes > number).any():
                    self._add(half, PASS_SPP[0], passes > number)
                    yield
            self._passes += 1

    def _add(self, half: int, size: int, chosen: Chosen) -> None:
        seed = seed_for(self._seed, "pass", self._passes, half)
        for tracer in self._sums[half]:
            tracer.add(seed=seed, spp=size, chosen=chosen)
        self._spp[half] += size if chosen is None else size * chosen
        self._count[half] += 1 if chosen is None else chosen
        self._read, self._squares = [], []

    def guide(self) -> None:
        """Let the passes from now on be guided (pipeline.renders.guide_table)."""
        for tracers in self._sums:
            for tracer in tracers:
                tracer.guide()

    def half_means(self) -> list[NDArray[np.float32]]:
        """Return the mean of each half, [P, R, R, 3]; raises as `mean`."""
        return [mean.astype(np.float32) for mean in self._means()]

    def mean(self) -> NDArray[np.float32]:
        """Return the mean of both halves, [P, R, R, 3].

        They weigh the same even where one has more samples: what one half is given goes by the
        other's, and weights by it would make the sum depend on itself (pipeline.renders.tiles).

        Raises:
            Rejected: "nonfinite_radiance" where a raw sample is not finite.
        """
        first, second = self._means()
        return ((first + second) / 2).astype(np.float32)

    def standard_error(self) -> NDArray[np.float64] | None:
        """Return that of the grey value of `mean`, [R, R], from the spread between all passes.

        It is infinite where there are fewer than LEAST_PASSES. None if there are several tracers,
        whose passes are not added.
        """
        if len(self._sums[0]) > 1:
            return None
        if not self._squares:  # read back once after each pass, as sums are
            self._squares = [tracers[0].read_squares() for tracers in self._sums]
        squares = np.stack(self._squares)
        greys = np.stack([mean.sum(axis=0).mean(axis=-1) for mean in self._means()])
        mean, count = greys.mean(axis=0), self._count.sum(axis=0)
        # Passes of n samples have the variance v / n, and the mean of a half of N has v / N.
        spread = (squares - self._spp * mean * (2 * greys - mean)).sum(axis=0)
        variance = np.maximum(spread, 0) / (count - 1)
        error = np.sqrt(variance * (1 / self._spp).sum(axis=0) / 4)
        return np.where(count < LEAST_PASSES, np.inf, error)

    def _means(self) -> list[NDArray[np.float64]]:
        pairs = zip(self._totals(), self._spp, strict=True)
        return [total / spp[..., None] for total, spp in pairs]

    def _totals(self) -> list[NDArray[np.float64]]:
        """Return the sums of both halves, [P, R, R, 3], read back once after each pass."""
        if not self._read:
            totals = [np.concatenate([each.read() for each in sums]) for sums in self._sums]
            broken = ~np.isfinite(totals).all(axis=(0, 1, -1))
            if broken.any():
                raise Rejected("nonfinite_radiance", f"{broken.sum()} pixels of raw samples")
            self._read = totals
        return self._read
