"""The samples of one view: two growing halves that share nothing, of each light apart or of all."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.renders.camera import PixelCamera
from pipeline.renders.settings import PASS_SPP
from pipeline.renders.tracer import Chosen, Tracer
from storage.seeds import seed_for


class DualBuffer:
    """Two growing sums of passes of one view, with no sample in common.

    There are P pictures: those of one tracer of all light, or those of the tracers of each emitter
    alone, one after another. The passes of all tracers have the same seeds, hence the same camera
    rays.
    """

    def __init__(
        self,
        tracers: Sequence[Tracer],
        camera: PixelCamera,
        seed: int,
        *,
        first_spp: int,
        max_spp: int,
        light_seed: int | None = None,
    ) -> None:
        """Begin a view without any sample.

        Args:
            tracers: what is traced.
            camera: the view.
            seed: of this view alone.
            first_spp: samples per pixel of the first measurement, both halves together.
            max_spp: the most that will be asked for.
            light_seed: of the light paths, which other views may have too; None: `seed`.
        """
        self._seed = seed
        self._light_seed = light_seed
        self._first = first_spp // 2
        self._most = max_spp // 2
        self.sums = [[tracer.pass_sum(camera) for tracer in tracers] for _ in range(2)]
        """Of each half, and in it of each tracer."""
        self.is_guided = False
        """True once a pass may be guided."""
        self._spp, self._count = np.zeros((2, 2, camera.resolution, camera.resolution), np.int64)
        self._passes = 0
        self.count_over(np.ones(self._spp.shape[1:], bool))

    def count_over(self, counted: NDArray[np.bool_]) -> None:
        """Let `spp` be a mean over some pixels, [R, R], from now on; before, it is over all."""
        self._counted = counted
        self._mean_spp: int | None = None

    @property
    def spp(self) -> int:
        """Samples per pixel so far, both halves together: the mean over the counted pixels."""
        if self._mean_spp is None:
            self._mean_spp = int(self._spp.sum(axis=0).mean(where=self._counted))
        return self._mean_spp

    def spp_of(self, half: int) -> NDArray[np.int64]:
        """Return the samples of each pixel in one half, [R, R]."""
        return self._spp[half]

    def count_of(self, half: int) -> NDArray[np.int64]:
        """Return the passes of each pixel in one half, [R, R]."""
        return self._count[half]

    @property
    def pass_spp(self) -> int:
        """Samples per pixel of the next pass of one half: the best that leads to round numbers.

        It divides what is there already and what is left, so that a half which has 64 samples goes
        on in passes of 64, however small its first ones were.
        """
        done = int(self._spp[0].max())
        remaining = (self._most if done else self._first) - done
        return next(size for size in PASS_SPP if done % size == 0 and remaining % size == 0)

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
        light_seed = self._light_seed
        if light_seed is not None:
            light_seed = seed_for(light_seed, "pass", self._passes, half)
        for tracer in self.sums[half]:
            tracer.add(seed=seed, spp=size, chosen=chosen, light_seed=light_seed)
        self._spp[half] += size if chosen is None else size * chosen
        self._count[half] += 1 if chosen is None else chosen
        self._mean_spp = None

    def guide(self) -> None:
        """Let the passes from now on be guided (pipeline.renders.guide_table)."""
        self.is_guided = True
        for tracers in self.sums:
            for tracer in tracers:
                tracer.guide()
